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
from trust.tables import EvaluationMessages
honest = cycle._told
def gossip(step, ids, *rest):
    told = honest(step, ids, *rest)
    n = len(told.observer)
    # Everybody repeats itself, judges what never existed and who was never there, and says what no verdict can be.
    sender = np.concatenate([told.observer, told.observer, told.observer, told.observer + 10**6, told.observer])
    index = told.detection_index
    k = np.concatenate([index, index, index + 5000, index, index])
    e = np.concatenate([told.evaluation, -told.evaluation, told.evaluation, told.evaluation, np.full(n, np.nan)])
    phi = np.concatenate([told.visibility, np.ones(n), told.visibility, told.visibility, np.full(n, 3.0)])
    evaluator = np.tile(np.repeat(np.arange(len(ids)), np.diff(told.ptr)), 5)
    order = np.argsort(evaluator, kind="stable")
    return EvaluationMessages(step, told.evaluator, 5 * told.ptr, sender[order], k[order], e[order], phi[order])
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
    assert set(refused) == {"bad_value", "unknown_observer", "unknown_detection", "duplicate"}
