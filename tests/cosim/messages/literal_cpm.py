"""Slow literal twins of the generation rules and of redundancy mitigation: one vehicle, one object, one rule."""

import math

PEOPLE = (1, 2)
"""Classes of type A: pedestrian and cyclist."""


class Vehicle:
    """One sender: what it last included, and when it last generated a message and described its sensors."""

    def __init__(self):
        self.included = []
        self.event_s = self.sensors_s = -math.inf

    def message(self, objects, time_s, gap_s, params, is_redundant):
        """What becomes of each object (a dict), in words, and whether the message describes the sensors."""
        fate = ["included" if o["transmitted"] else "withheld" for o in objects]
        waits = params.rules == "etsi" and time_s - self.event_s < min(max(gap_s, params.interval_s), 1.0) - 1e-9
        if waits:
            fate = ["waiting" if f == "included" else f for f in fate]
        elif params.rules == "etsi":
            self.event_s = time_s
        candidates = [i for i, f in enumerate(fate) if f == "included"]
        before = {i: self.last(objects[i], time_s) for i in candidates}
        if params.rules == "etsi":
            all_people = any(
                objects[i]["label"] in PEOPLE and before[i] and time_s - before[i]["time_s"] >= 0.5 - 1e-9
                for i in candidates
            )
            for i in candidates:
                if not self.is_due(objects[i], before[i], time_s, all_people):
                    fate[i] = "not due"
        for i in candidates:
            if fate[i] == "included" and not objects[i]["is_self"] and is_redundant(objects[i]):
                fate[i] = "redundant"
        others = [i for i in candidates if fate[i] == "included" and not objects[i]["is_self"]]
        ranked = sorted(others, key=lambda i: (-self.utility(objects[i], before[i], time_s), objects[i]["number"]))
        for i in ranked[params.max_objects :]:
            fate[i] = "over limit"
        replaced = [before[i] for i in candidates if fate[i] == "included"]
        self.included = [o for o in self.included if not any(o is r for r in replaced)]
        for o in filter(None, before.values()):
            o["seen_s"] = time_s
        self.forget(time_s)
        now = {"time_s": time_s, "seen_s": time_s}
        taken = [i for i in candidates if fate[i] == "included"]
        self.included += [objects[i] | now for i in taken]
        sends = params.rules == "all" or "included" in fate
        describes = sends and time_s - self.sensors_s >= 1 - 1e-9
        if describes:
            self.sensors_s = time_s
        return fate, describes

    def forget(self, time_s):
        """Drop what was a candidate a second ago or longer."""
        self.included = [o for o in self.included if time_s - o["seen_s"] < 1 - 1e-9]

    def last(self, one, time_s):
        """The object of this class that is expected nearest to this one, within 4 m; None if there is none."""
        near = []
        for n, o in enumerate(self.included):
            if (o["label"], o["is_self"]) == (one["label"], one["is_self"]):
                v = [0.0 if math.isnan(part) else part for part in o["velocity"]]
                expected = [p + (time_s - o["time_s"]) * q for p, q in zip(o["xy"], v, strict=True)]
                near.append((math.dist(expected, one["xy"]), n))
        distance, n = min(near, default=(math.inf, 0))
        return self.included[n] if distance <= 4 else None

    @staticmethod
    def is_due(one, before, time_s, all_people):
        """The rules, one by one."""
        if before is None:
            return True
        if one["label"] in PEOPLE:
            return all_people
        if math.dist(one["xy"], before["xy"]) > 4:
            return True
        if abs(one["speed"] - before["speed"]) > 0.5:
            return True
        if angle(one["yaw"], before["yaw"]) > math.radians(4):
            return True
        return time_s - before["time_s"] >= 1 - 1e-9

    @staticmethod
    def utility(one, before, time_s):
        """Quality and four changes, each from 0 to 1."""
        total = math.floor(15 * one["score"]) / 15
        if before is None:
            return total + 3 + (not math.isnan(one["speed"]))
        change = abs(one["speed"] - before["speed"])
        total += min(math.dist(one["xy"], before["xy"]) / 8, 1)
        total += 0 if math.isnan(change) else min(change, 1)
        total += min(math.degrees(angle(one["yaw"], before["yaw"])) / 8, 1)
        return total + min(max((time_s - before["time_s"] - 0.1) / 0.9, 0), 1)


def angle(a, b):
    """Between two headings."""
    return abs(math.remainder(a - b, 2 * math.pi))


def is_redundant(received, own_xy, one, time_s, params):
    """Whether a vehicle leaves out an object, by the messages that it received.

    `received` are (time of reception, message); a message has time, sender, sender_xy, and objects with label, xy,
    velocity and is_self.
    """
    if params.redundancy == "none":
        return False
    reports = []
    for received_s, message in received:
        if received_s < time_s - params.redundancy_window_s - 1e-9:
            continue
        best = None
        for said in message["objects"]:
            if said["label"] != one["label"] or said["is_self"] != (params.redundancy == "self_announcement"):
                continue
            ahead = time_s - message["time_s"]
            v = [0.0 if math.isnan(part) else part for part in said["velocity"]]
            distance = math.dist([p + ahead * q for p, q in zip(said["xy"], v, strict=True)], one["xy"])
            if distance <= 4 and (best is None or distance < best[0]):
                best = (distance, said)
        if best is not None:
            reports.append((received_s, message["sender"], message, best[1]))
    reports.sort(key=lambda r: r[:2])
    if not reports:
        return False
    if params.redundancy == "self_announcement":
        return True
    if params.redundancy == "frequency":
        return len(reports) > params.redundancy_reports
    if params.redundancy == "distance":
        return any(math.dist(m["sender_xy"], own_xy) <= params.redundancy_sender_m for _, _, m, _ in reports)
    _, _, _, said = reports[-1]
    if math.dist(said["xy"], one["xy"]) > params.redundancy_moved_m:
        return False
    change = abs(math.hypot(*said["velocity"]) - one["speed"])
    return math.isnan(change) or change <= params.redundancy_speed_mps
