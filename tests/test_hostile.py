"""What a hostile sender may send: it is counted, dropped and reported; it moves no trust and ends no run."""

import json

from results.archive import open_run
from results.recorder import fingerprint
from tests.drive import drive

DISK = ("radio.model=unit_disk", "radio.unit_disk.loss_p=0", "record.level=full")

NONSENSE = """
import dataclasses
import numpy as np
from cosim.v2x.messages import FABRICATED, Detections
honest = cycle.tamper
def hostile(seen, world, *rest):
    said = honest(seen, world, *rest)
    own = np.flatnonzero(said.k == 0)[:5]  # the first five vehicles also send what cannot be
    bad = said.take(np.repeat(own, 6))
    bad = dataclasses.replace(bad, k=900 + np.tile(np.arange(6), len(own)), score=bad.score.copy(),
                              origin=np.full(len(bad), FABRICATED, np.uint8))
    bad.boxes.xyz_m[0::6, 0] = np.nan
    bad.boxes.xyz_m[1::6, 1] = np.inf
    bad.boxes.lwh_m[2::6, 0] = 0.0
    bad.boxes.lwh_m[3::6, 2] = -1.5
    bad.score[4::6] = 7.0
    bad.score[5::6] = np.nan
    columns = [np.concatenate([a, b]) if isinstance(a, np.ndarray) else None
               for a, b in zip(said.columns(), bad.columns())]
    boxes = object.__new__(type(said.boxes))  # around the check that honest code passes through
    for name in ("xyz_m", "lwh_m", "yaw_rad"):
        object.__setattr__(boxes, name, np.concatenate([getattr(said.boxes, name), getattr(bad.boxes, name)]))
    joined = Detections.of([boxes if c is None else c for c in columns])
    order = np.lexsort((joined.k, joined.observer))
    for name in ("xyz_m", "lwh_m", "yaw_rad"):
        object.__setattr__(boxes, name, getattr(boxes, name)[order])
    return Detections.of([boxes if c is None else c[order] for c in columns])
cycle.tamper = hostile
"""

GOSSIP = """
import numpy as np
from trust.tables import Told
honest = cycle._told
def gossip(step, ids, *rest):
    told = honest(step, ids, *rest)
    n = len(told.sender)
    # Everybody repeats itself, judges what never existed and who was never there, and says what no verdict can be.
    sender = np.concatenate([told.sender, told.sender, told.sender, told.sender + 10**6, told.sender])
    k = np.concatenate([told.k, told.k, told.k + 5000, told.k, told.k])
    e = np.concatenate([told.e, -told.e, told.e, told.e, np.full(n, np.nan)])
    phi = np.concatenate([told.phi, np.ones(n), told.phi, told.phi, np.full(n, 3.0)])
    evaluator = np.tile(np.repeat(np.arange(len(ids)), np.diff(told.ptr)), 5)
    order = np.argsort(evaluator, kind="stable")
    return Told(step, told.evaluator, 5 * told.ptr, sender[order], k[order], e[order], phi[order])
cycle._told = gossip
"""


def summary(folder):
    return json.loads((folder / "manifest.json").read_text())["summary"]


def test_nonsense_in_detections_changes_nothing(tmp_path):
    base = drive(tmp_path / "base", *DISK)
    hostile = drive(tmp_path / "hostile", *DISK, before=NONSENSE)
    assert fingerprint(hostile) == fingerprint(base)
    assert summary(base)["detections_malformed"] == 0
    assert summary(hostile)["detections_malformed"] == 20 * 30


def test_gossip_in_verdicts_moves_no_trust(tmp_path):
    base = drive(tmp_path / "base", *DISK)
    hostile = drive(tmp_path / "hostile", *DISK, before=GOSSIP)
    assert open_run(hostile).trust.equals(open_run(base).trust)
    assert len(open_run(base).trust) > 100
    refused = summary(hostile)["verdicts_refused"]
    assert summary(base)["verdicts_refused"] == {}
    assert set(refused) == {"bad_value", "unknown_vehicle", "unknown_detection", "duplicate"}
