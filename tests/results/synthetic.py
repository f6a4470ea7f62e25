"""A made-up run with the structure of a real one: traffic on a grid, liars found out, a radio that fades."""

import numpy as np

from results.encounters import EncounterParams, EncounterTracker
from results.manifest import finish
from results.recorder import Recorder

N, BLOCK_M, SIDE = 60, 120.0, 6
SIZE = {"car": (4.5, 1.8, 1.5), "truck": (9.0, 2.5, 3.2), "pedestrian": (0.5, 0.6, 1.7)}


def write(folder, seed=0, steps=240, level="full", block_steps=60, reach_m=200.0, window_s=50):
    """Write a run; actors 0-29 equipped (0-3 malicious from step 60, 4-6 unreliable), 30-49 not, 50-59 on foot."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    kind = np.array(["car"] * 45 + ["truck"] * 5 + ["pedestrian"] * 10)
    lwh = np.array([SIZE[k] for k in kind])
    role = np.array(["malicious"] * 4 + ["unreliable"] * 3 + ["honest"] * 53)
    equipped = np.arange(N) < 30
    first, last = np.zeros(N, int), np.full(N, steps - 1)
    first[20:50] = rng.integers(0, steps // 2, 30)
    last[20:50] = first[20:50] + rng.integers(steps // 6, steps, 30).clip(max=steps - 1 - first[20:50])
    tracks, yaws, speeds = _drive(rng, steps, np.where(kind == "pedestrian", 1.3, 9.0))
    lied = (np.arange(N) < 4, np.full(N, 60).clip(min=first))
    ledgers = [EncounterTracker(EncounterParams(radius_m=r, pairs="all"), 1.0) for r in (50.0, 100.0)]
    belief, heard_s = np.full(N, 0.5), np.full((N, N), -1)
    evidence = np.zeros(N, int)

    with Recorder(folder, level, block_steps) as record:
        for step in range(steps):
            here = np.flatnonzero((first <= step) & (step <= last))
            talk = here[equipped[here]]
            xyz = np.column_stack([tracks[step], lwh[:, 2] / 2])
            record.append("actors", step, {
                "actor": here, "x_m": xyz[here, 0], "y_m": xyz[here, 1], "z_m": xyz[here, 2],
                "yaw_rad": yaws[step, here], "speed_mps": speeds[here],
            })  # fmt: skip
            _meet(record, ledgers, step, here, talk, xyz, belief, reach_m, rng, heard_s)
            _see(record, step, here, talk, xyz, yaws[step], lwh, kind, role, lied, rng)
            evidence[talk] += 3
            if step % 5 == 4 and len(talk):
                goal = np.select([lied[0] & (step >= lied[1]), role == "unreliable"], [0.02, 0.45], 0.7)
                belief = belief + (goal - belief) * 0.12 + rng.normal(0, 0.012, N)
                belief = belief.clip(0, 1)
                record.append("trust", step, {
                    "variant": np.zeros(len(talk), int), "subject": talk, "trust": belief[talk], "uncertainty": None,
                    "weight": evidence[talk] * 0.7,
                    "state": np.where(evidence[talk] > 0, 0, 1), "n_evaluations": evidence[talk],
                    "n_evaluators": np.minimum(evidence[talk], 7),
                    "newest_evaluation_age_s": rng.exponential(2, len(talk)),
                    "newest_evaluation_age_s__valid": evidence[talk] > 0,
                    "oldest_evaluation_age_s": np.minimum(step - first[talk], window_s) * 1.0,
                    "oldest_evaluation_age_s__valid": evidence[talk] > 0,
                })  # fmt: skip
        for ledger in ledgers:
            record.append("encounters", steps - 1, ledger.close(steps))
        record.append("vehicles", steps - 1, {
            "vehicle": np.arange(N), "sumo_id": np.array([f"trip_{i}" for i in range(N)]), "vehicle_class": kind,
            "length_m": lwh[:, 0], "width_m": lwh[:, 1], "height_m": lwh[:, 2], "equipped": equipped,
            "role": role, "role__valid": equipped, "first_step": first, "last_step": last,
            "n_steps": last - first + 1,
            "attack": (role == "unreliable").astype(int), "attack__valid": equipped & (role != "honest"),
            "attack_start_step": lied[1], "attack_start_step__valid": lied[0] & (lied[1] <= last),
        })  # fmt: skip
        record.append("pseudonyms", steps - 1, {
            "pseudonym": np.flatnonzero(equipped), "vehicle": np.flatnonzero(equipped),
            "identity": np.zeros(equipped.sum(), int), "from_step": first[equipped], "to_step": last[equipped],
        "refused_step": None,
        })  # fmt: skip
    manifest = {
        "dt_s": 1.0, "steps": steps, "seed": seed,
        "config": {
            "radio": {"model": "unit_disk", "range_m": reach_m, "unit_disk": {"loss_p": 0.05},
                      "relay": {"max_hops": 1}},
            "attacks": [{"attack": "ghost_insertion", "share_p": 0.13}, {"attack": "unreliable", "share_p": 0.1}],
            "fleet": {"penetration_p": 0.6, "equipped_kinds": ["car"]}, "trust": {"window_s": window_s},
        }, "versions": {"cosim": "0.1.0"},
        "net": {"name": "grid", "sha256": "0" * 64}, "timings_s": {"traffic": 1.5, "sensing": 3.2, "trust": 0.7},
        "summary": {"vehicles": 50},
    }  # fmt: skip
    finish(folder, manifest)
    return folder


def _drive(rng, steps, speed):
    """Along the streets of a grid, turning at random where they meet, wherever a street ends back again."""
    size = BLOCK_M * SIDE
    at = rng.integers(0, SIDE + 1, (N, 2)) * BLOCK_M
    heading = rng.integers(0, 4, N)
    tracks, yaws = np.zeros((steps, N, 2)), np.zeros((steps, N))
    point, left = at.astype(float), np.full(N, BLOCK_M)
    ways = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    for step in range(steps):
        outside = ((point + ways[heading] * BLOCK_M < -1) | (point + ways[heading] * BLOCK_M > size + 1)).any(axis=1)
        turn = (left >= BLOCK_M) & (outside | (rng.random(N) < 0.4))
        while turn.any():
            heading = np.where(turn, rng.integers(0, 4, N), heading)
            ahead = point + ways[heading] * BLOCK_M
            turn = turn & ((ahead < -1) | (ahead > size + 1)).any(axis=1)
        left = np.where(left >= BLOCK_M, 0, left)
        move = np.minimum(speed, BLOCK_M - left)
        point = point + ways[heading] * move[:, None]
        left = left + move
        yaws[step] = np.array([0, np.pi / 2, np.pi, -np.pi / 2])[heading]
        kerb = np.column_stack([-np.sin(yaws[step]), np.cos(yaws[step])]) * -2.0
        tracks[step] = point + kerb
    return tracks, yaws, speed


def _meet(record, ledgers, step, here, talk, xyz, belief, reach_m, rng, heard_s):
    a, b = (here[index] for index in np.triu_indices(len(here), 1))
    distance = np.hypot(*(xyz[a, :2] - xyz[b, :2]).T)
    los = (np.abs(xyz[a, :2] - xyz[b, :2]).min(axis=1)) < 6
    one, other = np.r_[a, b], np.r_[b, a]
    far, seen = np.r_[distance, distance], np.r_[los, los]
    reach = np.isin(one, talk) & np.isin(other, talk) & (far <= reach_m)
    one, other, far, seen = one[reach], other[reach], far[reach], seen[reach]
    faded = rng.random(len(one)) < np.where(seen, 0.02, 0.1) + (far / reach_m) ** 3 * 0.6
    hit = ~faded & (rng.random(len(one)) < 0.05)
    got = ~(faded | hit)
    for ledger in ledgers:
        closed, opened = ledger.update(step, a, b, distance, los, here)
        record.append("encounters", step, closed)
        new = opened[np.isin(a[opened], talk) & np.isin(b[opened], talk)]
        for x, y in ((a[new], b[new]), (b[new], a[new])):
            known = heard_s[x, y] >= 0
            age = np.where(known, step - heard_s[x, y], 0)
            source, state = np.where(known, 0, 2), np.where(known, 0, 3)
            ledger.first_contact(x, y, np.where(known, belief[y], 0.5), source, state, age)
        ledger.count_messages(one[got], other[got])
        had = got & (heard_s[other, one] >= 0)
        ledger.note_trust(other[had], one[had], np.ones((int(had.sum()), 1), bool))
        ledger.count_evaluations(other[got], one[got], rng.integers(1, 4, got.sum()))
    sent = len(talk)
    lost = {"n_in_range": len(one), "n_delivered": got.sum(), "n_lost_propagation": faded.sum(),
            "n_lost_collision": hit.sum(), "n_lost_receiver_busy": 0, "n_lost_expired": 0, "n_lost_late": 0,
            "n_relayed": 0, "n_duplicate": 0}  # fmt: skip
    record.append("radio", step, {
        "message_type": np.zeros(1, int), "n_sent": np.array([sent]), **{k: np.array([v]) for k, v in lost.items()},
        "sent_bytes": np.array([sent * 350.0]), "cbr": np.array([0.002 * sent]),
    })  # fmt: skip
    ring = 2 * (far // 25).astype(int) + ~seen
    rings = np.unique(ring)
    count = {name: np.bincount(ring[rows], minlength=rings.max(initial=0) + 1)[rings] for name, rows in (
        ("n_in_range", slice(None)), ("n_delivered", got), ("n_lost_propagation", faded), ("n_lost_collision", hit),
    )}  # fmt: skip
    zero = np.zeros(len(rings), int)
    none = {name: zero for name in ("message_type", "n_lost_receiver_busy", "n_lost_expired", "n_lost_late")}
    record.append("pdr_by_distance", step, {"distance_bin_m": rings // 2 * 25, "los_state": rings % 2, **count, **none})
    latency_s = 0.0005 + rng.exponential(0.001, got.sum())
    bins, n = np.unique(np.floor(2 * np.log2(latency_s / 1e-4)), return_counts=True)
    record.append("latency_histogram", step, {
        "message_type": np.zeros(len(bins), int), "latency_s": 1e-4 * 2 ** (bins / 2), "n_delivered": n,
    })  # fmt: skip
    gaps = np.arange(1, 4)
    record.append("packet_inter_reception", step, {
        "message_type": np.zeros(3, int), "pir_steps": gaps, "n_received": got.sum() // 3**gaps,
        "n_censored": np.full(3, 1),
    })  # fmt: skip
    record.append("vehicle_channel", step, {
        "vehicle": talk, "cbr": rng.uniform(0, 0.1, len(talk)),
        "n_in_range": np.bincount(other, minlength=N)[talk], "n_received": np.bincount(other[got], minlength=N)[talk],
    })  # fmt: skip
    one_row = {name: np.array([n]) for name, n in (("n_reports", sent), ("n_reached", sent - 1), ("n_lost", 1),
               ("n_late", 0), ("n_over_capacity", 0), ("n_outage", 0), ("uplink_bytes", 300.0 * sent))}  # fmt: skip
    record.append("server", step, {
        "variant": np.zeros(1, np.int8), **one_row,
        "n_addressed": np.array([sent * (step % 5 == 4)]), "n_informed": np.array([sent * (step % 5 == 4)]),
    })  # fmt: skip
    record.append("receptions", step, {
        "message_type": np.zeros(got.sum(), int),
        "sender": one[got], "receiver": other[got], "hops": np.ones(got.sum(), int),
        "generation_offset_s": rng.uniform(0, 0.2, got.sum()), "access_delay_s": latency_s - 0.0005,
        "latency_s": latency_s,
        "distance_m": far[got],
    })  # fmt: skip
    renew = (step % 5 == 0) & (rng.random(got.sum()) < 0.8) & (step > 8)
    subject, receiver = one[got], other[got]
    heard_s[receiver[renew], subject[renew]] = step - rng.integers(0, 3, renew.sum())
    known = heard_s[receiver, subject] >= 0
    age_s = (step - heard_s[receiver, subject]).clip(0) * 1.0
    record.append("trust_lookups", step, {
        "variant": np.zeros(len(receiver), int), "receiver": receiver, "subject": subject,
        "trust": np.where(known, belief[subject], 0.5),
        "source": np.where(known, 0, 2), "state": np.where(known, 0, 3), "age_s": age_s, "age_s__valid": known,
        "n_evaluations": 9 * known, "n_evaluators": 3 * known,
        "newest_evaluation_age_s": age_s + 1, "newest_evaluation_age_s__valid": known,
        "oldest_evaluation_age_s": age_s + 9, "oldest_evaluation_age_s__valid": known,
    })  # fmt: skip


def _see(record, step, here, talk, xyz, yaw, lwh, kind, role, lied, rng):
    label = np.array([{"car": 0, "truck": 3, "pedestrian": 1}[k] for k in kind])
    o, t = (grid.ravel() for grid in np.meshgrid(talk, here, indexing="ij"))
    d = np.hypot(*(xyz[o, :2] - xyz[t, :2]).T)
    near = (o != t) & (d < 70)
    o, t, d = o[near], t[near], d[near]
    free = (20000 / np.maximum(d, 3) ** 2).astype(int) + 1
    street = np.abs(xyz[o, :2] - xyz[t, :2]).min(axis=1) < 6
    points = np.where(street, free * rng.choice([1, 0.7, 0.3], len(o)), 0).astype(int)
    record.append("observability", step, {"observer": o, "actor": t, "n_points": points, "n_unoccluded": free})
    seen = points >= 8
    o, t, points, free = o[seen], t[seen], points[seen], free[seen]
    liar = np.flatnonzero(lied[0] & (step >= lied[1]))
    liar = liar[np.isin(liar, talk)]
    n, m, s = len(o), len(liar), len(talk)
    observer, truth = np.r_[talk, o, liar], np.r_[talk, t, liar]
    noise = np.r_[np.zeros((s, 3)), rng.normal(0, 0.08, (n, 3)), np.zeros((m, 3))]
    forward = np.column_stack([np.cos(yaw[liar]), np.sin(yaw[liar]), np.zeros(m)]) * 12
    box = np.r_[xyz[talk], xyz[t], xyz[liar] + forward] + noise
    score = np.r_[np.ones(s), rng.beta(8, 2, n), np.ones(m)]
    origin = np.r_[np.ones(s, int), np.zeros(n, int), np.full(m, 2)]
    k = np.r_[np.zeros(s, int), _position(o), np.full(m, 200)]
    sent = (origin > 0) | (role[observer] != "unreliable") | (rng.random(len(observer)) < 0.9)
    true = origin < 2
    iou = (1 - 3 * np.abs(noise).mean(axis=1)).clip(0, 1)
    sides = {"length_m": lwh[truth, 0], "width_m": lwh[truth, 1], "height_m": lwh[truth, 2], "yaw_rad": yaw[truth]}
    boxes = {"x_m": box[:, 0], "y_m": box[:, 1], "z_m": box[:, 2], **sides}
    truths = {"truth_actor": truth, "truth_actor__valid": true, "truth_iou": iou, "truth_iou__valid": true}
    record.append("detections", step, {
        "observer": observer, "detection_index": k, "class": label[truth], **boxes, "score": score,
        "n_points": np.r_[np.zeros(s, int), points, np.zeros(m, int)],
        "speed_mps": np.zeros(len(box)), "speed_mps__valid": origin == 0,
        "acceleration_mps2": np.zeros(len(box)), "acceleration_mps2__valid": origin == 0,
        "origin": origin, "transmitted": sent, "lied": origin == 2,
        "withheld": ~sent, "target": None, **truths,
        "truth_occlusion": np.r_[np.zeros(s), 1 - points / free, np.zeros(m)], "truth_occlusion__valid": true,
    })  # fmt: skip
    e, j = (grid.ravel() for grid in np.meshgrid(talk, np.flatnonzero(sent), indexing="ij"))
    close = (np.hypot(*(xyz[e, :2] - box[j, :2]).T) < 120) & (e != observer[j])
    e, j = e[close], j[close]
    record.append("evaluations", step, {
        "evaluator": e, "observer": observer[j], "detection_index": k[j],
        "evaluation": np.where(true[j], score[j], -1), "visibility": rng.random(len(e)),
        "n_points": rng.integers(0, 90, len(e)),
        "plausible": None, "matched": true[j], "lied": np.zeros(len(e), bool),
    })  # fmt: skip
    lie = np.flatnonzero(origin[j] == 2)
    record.append("attack_outcomes", step, {
        "variant": np.zeros(len(lie), int), "effect": np.zeros(len(lie), int), "observer": observer[j[lie]],
        "detection_index": k[j[lie]], "receiver": e[lie], "intended": e[lie] % 5 == observer[j[lie]] % 5,
        "in_path": e[lie] % 2 == 0, "ego_detected": np.zeros(len(lie), bool), "score": np.full(len(lie), 0.6),
        "score__valid": e[lie] % 3 == 0,
    })  # fmt: skip
    own = np.flatnonzero(origin == 0)
    believes, row = np.r_[observer[own], e], np.r_[own, j]
    strong = np.r_[score[own], np.where(true[j], score[j], score[j] * rng.random(len(j)) ** 2)]
    keep = (truth[row] != believes) | ~true[row]
    believes, row, strong = believes[keep], row[keep], strong[keep]
    local = observer[row] == believes
    _, first = np.unique(np.column_stack([believes, np.where(true[row], truth[row], 1000 + observer[row])]), axis=0,
                         return_index=True)  # fmt: skip
    believes, row, strong, local = believes[first], row[first], strong[first], local[first]
    record.append("fused", step, {
        "variant": np.zeros(len(row), int), "observer": believes, "fused_index": _position(believes), "score": strong,
        "n_sources": np.ones(len(row), int), "ego_detected": local, "source": observer[row], "source_index": k[row],
        "pose": None, "pose_index": None, "fabricated": origin[row] == 2,
    })  # fmt: skip


def _position(owner):
    """1, 2, ... within each owner."""
    order = np.argsort(owner, kind="stable")
    position = np.zeros(len(owner), int)
    ordered = owner[order]
    position[order] = np.arange(len(owner)) - np.searchsorted(ordered, ordered) + 1
    return position
