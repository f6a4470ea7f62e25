"""Decisions about detection messages against their slow literal twins."""

import numpy as np
import pytest

from cosim.messages.content import SELF, SENSED, Detections
from cosim.messages.cpm_generation import CpmState, Generators, Inclusion, generate
from cosim.messages.cpm_params import CpmParams
from cosim.messages.redundancy import ReportedObjects
from tests.cosim.messages import literal_cpm
from tests.sensors.town import boxes_at

WORDS = {
    "included": Inclusion.INCLUDED, "withheld": Inclusion.WITHHELD, "waiting": Inclusion.WAITING,
    "not due": Inclusion.NOT_DUE, "redundant": Inclusion.REDUNDANT, "over limit": Inclusion.OVER_LIMIT,
}  # fmt: skip


class Story:
    """Random vehicles and objects on a square; every vehicle sees some objects, and hears some vehicles."""

    def __init__(self, seed, params, n_vehicles=12, n_objects=30, side_m=90.0):
        self.g, self.params = np.random.default_rng(seed), params
        g, n = self.g, n_vehicles + n_objects
        self.n, self.xy, self.yaw = n_vehicles, g.uniform(0, side_m, (n, 2)), g.uniform(-np.pi, np.pi, n)
        self.label = np.where(np.arange(n) < n_vehicles, 0, g.integers(0, 4, n))
        self.speed = g.choice([0.0, 1.5, 8.0, 14.0], n)
        self.time_s, self.state = 0.0, CpmState()
        self.actor = np.sort(g.choice(1000, n_vehicles, False))
        self.twins = [literal_cpm.Vehicle() for _ in range(n_vehicles)]
        self.received = [[] for _ in range(n_vehicles)]

    def step(self):
        """One step of both; how many decisions there were of each kind, after comparing them."""
        g, dt_s = self.g, float(self.g.choice([0.1, 0.2, 0.3]))
        self.time_s += dt_s
        self.speed = np.clip(self.speed + g.normal(0, 0.3, len(self.speed)), 0, 20)
        self.yaw = self.yaw + g.normal(0, 0.03, len(self.yaw))
        self.xy = self.xy + dt_s * self.speed[:, None] * np.column_stack([np.cos(self.yaw), np.sin(self.yaw)])
        present = np.flatnonzero(g.random(self.n) < 0.9)
        listed, message = self.lists(present)
        gap_s = g.choice([0.0, 0.1, 0.25, 2.0], len(present))
        generators = Generators(self.actor[present] << 16, self.actor[present], self.xy[present], gap_s)
        self.state, content = generate(self.state, listed, message, generators, self.time_s, self.params)
        wanted, sensors = self.literally(listed, message, present, gap_s)
        assert content.inclusion.tolist() == wanted
        assert content.has_sensors.tolist() == sensors
        self.exchange(listed, message, present, content.included)
        return np.bincount(content.inclusion, minlength=len(Inclusion))

    def lists(self, present):
        """Lists of detections of these vehicles, their own reports first, and the message of each."""
        g, rows = self.g, []
        for m, v in enumerate(present):
            seen = np.flatnonzero((np.hypot(*(self.xy - self.xy[v]).T) < 40) & (g.random(len(self.xy)) < 0.85))
            rows += [(m, v, v)] + [(m, v, o) for o in seen if o != v]
        m, v, o = np.array(rows).reshape(-1, 3).T
        n, is_self = len(m), o == v
        xyz = np.column_stack([self.xy[o] + g.normal(0, 0.2, (n, 2)) * ~is_self[:, None], np.zeros(n)])
        unknown = is_self | (g.random(n) < 0.3)
        heading = np.column_stack([np.cos(self.yaw[o]), np.sin(self.yaw[o])])
        listed = Detections(
            observer=v, detection_index=np.arange(n) - np.searchsorted(m, m), label=self.label[o].astype(np.uint8),
            boxes=boxes_at(xyz, yaw_rad=self.yaw[o] + g.normal(0, 0.02, n)), score=g.random(n),
            n_points=np.zeros(n, np.int32), origin=np.where(is_self, SELF, SENSED).astype(np.uint8),
            transmitted=g.random(n) < 0.97, speed_mps=np.where(is_self, self.speed[o], np.nan),
            velocity_mps=np.where(unknown[:, None], np.nan, (self.speed[o] + g.normal(0, 0.2, n))[:, None] * heading),
        )  # fmt: skip
        return listed, m

    def literally(self, listed, message, present, gap_s):
        """The same decisions by the twins."""
        wanted, sensors = [], []
        for m, v in enumerate(present):
            objects = [self.literal(listed, i) for i in np.flatnonzero(message == m)]

            def is_redundant(one, v=v):
                return literal_cpm.is_redundant(self.received[v], self.xy[v].tolist(), one, self.time_s, self.params)

            fate, describes = self.twins[v].message(objects, self.time_s, gap_s[m], self.params, is_redundant)
            wanted += [WORDS[f] for f in fate]
            sensors.append(describes or self.params.length == "linear")
        for absent in set(range(self.n)) - set(present.tolist()):
            self.twins[absent].forget(self.time_s)
        return wanted, sensors

    @staticmethod
    def literal(listed, i):
        """One detection as a dict: of the vehicle itself with the speed that it states, of others with a velocity."""
        is_self = bool(listed.origin[i] == SELF)
        v, yaw = float(listed.speed_mps[i]), float(listed.boxes.yaw_rad[i])
        velocity = [v * np.cos(yaw), v * np.sin(yaw)] if is_self else listed.velocity_mps[i].tolist()
        return {
            "label": int(listed.label[i]), "xy": listed.boxes.xyz_m[i, :2].tolist(), "yaw": yaw,
            "score": float(listed.score[i]), "speed": v if is_self else float(np.hypot(*velocity)),
            "velocity": velocity, "number": int(listed.detection_index[i]), "is_self": is_self,
            "transmitted": bool(listed.transmitted[i]),
        }  # fmt: skip

    def exchange(self, listed, message, present, included):
        """Random receptions of what was sent, noted on both sides."""
        g, rows = self.g, np.flatnonzero(included)
        is_self = listed.origin[rows] == SELF
        along = np.column_stack([np.cos(listed.boxes.yaw_rad[rows]), np.sin(listed.boxes.yaw_rad[rows])])
        velocity = np.where(is_self[:, None], listed.speed_mps[rows, None] * along, listed.velocity_mps[rows])
        reports = ReportedObjects(
            time_s=np.full(len(present), self.time_s), sender=self.actor[present] << 16, sender_xy_m=self.xy[present],
            message=message[rows], label=listed.label[rows].astype(np.int64), xy_m=listed.boxes.xyz_m[rows, :2],
            velocity_mps=velocity, is_self=is_self,
        )  # fmt: skip
        receiver, of = np.nonzero(g.random((len(present), len(present))) < 0.6)
        other = receiver != of
        receiver, of = receiver[other], of[other]
        received_s = self.time_s + g.uniform(0.001, 0.09, len(of))
        heard = self.state.heard.next(
            reports, self.actor[present][receiver], of, received_s, self.params.redundancy_window_s
        )
        self.state = CpmState(self.state.included, self.state.generated, self.state.described, heard)
        objects = [
            {"label": int(reports.label[i]), "xy": reports.xy_m[i].tolist(), "velocity": velocity[i].tolist(),
             "is_self": bool(is_self[i])} for i in range(len(rows))
        ]  # fmt: skip
        said = [
            {"time_s": self.time_s, "sender": int(self.actor[v]), "sender_xy": self.xy[v].tolist(),
             "objects": [objects[i] for i in np.flatnonzero(reports.message == m)]}
            for m, v in enumerate(present)
        ]  # fmt: skip
        for r, m, at_s in zip(receiver.tolist(), of.tolist(), received_s.tolist(), strict=True):
            self.received[present[r]].append((at_s, said[m]))
        horizon_s = self.time_s - self.params.redundancy_window_s - 1.0
        self.received = [[got for got in mine if got[0] > horizon_s] for mine in self.received]


CHOICES = {
    "all": {"max_objects": 4},
    "rules": {"rules": "etsi", "length": "uper"},
    "limit": {"rules": "etsi", "max_objects": 3, "interval_s": 0.2},
    "frequency": {"rules": "etsi", "redundancy": "frequency", "redundancy_reports": 2, "length": "uper"},
    "dynamics": {"rules": "etsi", "redundancy": "dynamics", "redundancy_moved_m": 2.0},
    "distance": {"redundancy": "distance", "redundancy_sender_m": 25.0, "max_objects": 8},
    "self-announcement": {"rules": "etsi", "redundancy": "self_announcement", "redundancy_window_s": 0.5},
}


def decisions(name, at_least, seed=0):
    """Decisions of each kind, in stories of forty steps."""
    total = np.zeros(len(Inclusion), np.int64)
    while total.sum() < at_least:
        story, seed = Story(seed, CpmParams(**CHOICES[name])), seed + 1
        for _ in range(40):
            total += story.step()
    return total


@pytest.mark.parametrize("name", CHOICES)
def test_decisions_equal_the_literal_twin(name):
    total = decisions(name, 3000)
    choice = CHOICES[name]
    assert (total[Inclusion.REDUNDANT] > 20) == ("redundancy" in choice)
    assert (total[Inclusion.OVER_LIMIT] > 20) == ("max_objects" in choice)
    assert (min(total[Inclusion.NOT_DUE], total[Inclusion.WAITING]) > 20) == (choice.get("rules") == "etsi")


@pytest.mark.verify
@pytest.mark.parametrize("name", CHOICES)
def test_a_hundred_thousand_decisions(name):
    assert decisions(name, 100_000, seed=100).sum() >= 100_000
