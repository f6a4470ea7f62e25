"""Detection of misbehaviour on a `veremi-nextgen` export, by the plausibility checks published with that data set.

The checks (CaTCH: Kamel et al., 2019, as VeReMi NextGen's repository carries them, in their form for noise 0 and with
their default bounds) are written anew here, and read the files with a reader of their own. They know nothing of the
run: if frames, units, times or signs were wrong, honest messages would break them.
"""

import json

import numpy as np
import pandas as pd
import pytest

from cosim.addons.export.export import export
from results.archive import open_run
from tests.drive import drive

RANGE_M, SPEED_MPS, ACCELERATION_MPS2, DECELERATION_MPS2 = 418.14, 62.33, 5.4186, 5.0053
BESIDE_ROAD_M, PARKED_MPS = -4.498, 0.68
GAP_S, ABOVE_M, BELOW_M = 4.724, 0.7064, 1.0299

CONFIG = """
[traffic]
duration_s = 30
warmup_s = 300

[record]
level = "full"

[[attacks]]
attack = "offset"
content = "self_report"
offset = "random"
share_p = 0.15
start_s = 10

[[attacks]]
attack = "speed"
share_p = 0.15
start_s = 10
"""


def messages(folder):
    """All received messages: times in seconds, positions in metres, and of each sender's message before it."""
    rows = []
    for path in sorted(folder.glob("*.json")):
        for m in json.loads(path.read_text()):
            at = [float(c) for side in ("sender", "receiver") for c in m[side]["pos"].split(",")[:2]]
            sender = m["sender"]
            rows.append((path.stem, m["sender_id"], int(m["sendTime"]) / 1e9, int(m["attacker"]), *at,
                         float(sender["spd"]), float(sender["distance_to_road_edge"])))  # fmt: skip
    names = ["receiver", "sender", "t", "attacker", "x", "y", "own_x", "own_y", "v", "edge"]
    found = pd.DataFrame(rows, columns=names).sort_values(["receiver", "sender", "t"], ignore_index=True)
    before = found.groupby(["receiver", "sender"])[["t", "x", "y", "v"]].shift()
    return found.join(before.add_suffix("0"))


def broken(m):
    """Which checks each message breaks."""
    dt, moved = m.t - m.t0, np.hypot(m.x - m.x0, m.y - m.y0)
    mean, change = (m.v + m.v0) / 2, (m.v - m.v0).abs()
    a = change / dt
    share = np.select([a < 1, a < 2.5, a < 5], [0.02, 0.03 + 0.02 * (a - 1), 0.05 + 0.02 * (a - 2.5)], 0.1)
    share = share * np.select([mean > 30, mean > 20], [0.7, 0.85], 1.0)
    slack = np.select([change < 1, change < 3], [1.0, 2.0], np.inf)
    least = mean * dt - np.minimum(np.minimum(mean * dt * share, DECELERATION_MPS2 / 4 * dt**2), slack)
    most = mean * dt + np.minimum(np.minimum(mean * dt * share, ACCELERATION_MPS2 / 4 * dt**2), slack)
    slow = np.minimum(m.v, m.v0)
    least = least - np.maximum(0, BELOW_M + 0.3571 * slow - 0.01694 * slow**2)
    standing = (np.maximum(m.v, m.v0) < 1) & (moved <= np.maximum(m.v, m.v0) * dt)
    return pd.DataFrame({
        "range": np.hypot(m.x - m.own_x, m.y - m.own_y) > RANGE_M,
        "position": (m.edge < BESIDE_ROAD_M) & (m.v > PARKED_MPS),
        "speed": m.v > SPEED_MPS,
        "position consistency": moved > SPEED_MPS * dt,
        "speed consistency": change > np.where(m.v > m.v0, ACCELERATION_MPS2, DECELERATION_MPS2) * dt,
        "position and speed": ~standing & (dt < GAP_S) & ((moved < least) | (moved > most + ABOVE_M)),
    })  # fmt: skip


@pytest.mark.verify
def test_published_checks_find_the_attackers(tmp_path):
    """Of the liars' messages 8 in 10 are found; of honest ones, 1 in 1000 breaks a check other than the last.

    The last compares distance with the mean of two speeds; SUMO moves a vehicle by its last speed, and a bend is
    longer than its chord: honest vehicles break it more often.
    """
    (tmp_path / "liars.toml").write_text(CONFIG)
    run = open_run(drive(tmp_path / "run", config=tmp_path / "liars.toml"))
    export(run, "veremi-nextgen", tmp_path / "out")
    found = messages(tmp_path / "out")
    assert len(found) == (run.receptions.message_type == "cpm").sum()
    wrong = broken(found)
    lies, honest = found.attacker == 1, found.attacker == 0
    assert lies.sum() > 1000 and wrong[lies].any(axis=1).mean() > 0.8
    assert wrong[honest].drop(columns="position and speed").any(axis=1).mean() < 0.002
    assert wrong[honest].any(axis=1).mean() < 0.2
    assert (wrong[lies].mean()[["position", "position consistency", "position and speed"]] > 0.1).all()
    # by sender: the share of messages that break a check tells attackers from others
    late = found.t >= 10
    score = wrong[late].any(axis=1).groupby(found.sender[late]).mean()
    is_liar = found[late].groupby("sender").attacker.max() == 1
    above = score[is_liar].to_numpy()[:, None] - score[~is_liar].to_numpy()
    assert ((above > 0) + 0.5 * (above == 0)).mean() > 0.9
