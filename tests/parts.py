"""Parts that tests put in the place of those that ship; configs name them as `tests.parts:Name`."""

from copy import deepcopy
from dataclasses import dataclass, fields, replace

import numpy as np

from cosim.attacks.ghost_insertion import GhostInsertion, GhostInsertionParams
from cosim.messages.content import FABRICATED, SELF, Detections
from cosim.radio.unit_disk import UnitDiskMedium
from sensors.boxes import Boxes
from sensors.statistical_detector import DetectorParams, StatisticalDetector
from trust.models.trupercept import TruPercept
from trust.tables import EvaluationMessages, ReceivedEvaluations


class MixedActors:
    """The default detector, with the true actors of each observer's reports mixed up."""

    Params = DetectorParams

    def __init__(self, params):
        self.honest = StatisticalDetector(replace(params, model=DetectorParams().model))

    def detect(self, *args):
        """Each observer's actors in reverse order."""
        writable = deepcopy(args)  # for arrays that are read-only, a kernel would be compiled once more
        reports = self.honest.detect(*writable)
        real = np.flatnonzero(~reports.is_false_positive)
        forwards = real[np.lexsort((real, reports.observer[real]))]
        backwards = real[np.lexsort((-real, reports.observer[real]))]
        actor = reports.actor.copy()
        actor[forwards] = reports.actor[backwards]
        return replace(reports, actor=actor)


@dataclass(frozen=True, kw_only=True)
class GhostsParams(GhostInsertionParams):
    """Ghost insertion, and whether the origin of detections is mixed up."""

    mixed: bool = False


class Ghosts(GhostInsertion):
    """Ghosts that their attacker does not vouch for."""

    Params = GhostsParams

    def detections(self, listed, context):
        """The ghosts; where asked, the origins of each attacker's list in reverse order."""
        listed = super().detections(listed, context)
        if not self.params.mixed:
            return listed
        rows = np.flatnonzero(context.attacker[listed.observer] & (listed.origin != SELF))
        backwards = rows[np.lexsort((-rows, listed.observer[rows]))]
        origin = listed.origin.copy()
        origin[rows] = listed.origin[backwards]
        return replace(listed, origin=origin)

    def evaluations(self, rows, detections, context):
        """As they are."""
        return rows.evaluation, rows.visibility


class Compliant:
    """An attack that changes nothing."""

    def detections(self, listed, context):
        """As they are."""
        return listed


def unchecked(boxes, **columns):
    """Boxes past the check of their constructor."""
    made = object.__new__(Boxes)
    for name in (f.name for f in fields(Boxes)):
        object.__setattr__(made, name, columns.get(name, getattr(boxes, name)))
    return made


class Nonsense:
    """Every attacker also sends six detections that cannot be."""

    def detections(self, listed, context):
        """No finite position, no size, no score."""
        own = np.flatnonzero((listed.detection_index == 0) & context.attacker[listed.observer])
        bad = listed.take(np.repeat(own, 6))
        xyz_m, lwh_m, score = bad.boxes.xyz_m.copy(), bad.boxes.lwh_m.copy(), bad.score.copy()
        xyz_m[0::6, 0], xyz_m[1::6, 1] = np.nan, np.inf
        lwh_m[2::6, 0], lwh_m[3::6, 2] = 0.0, -1.5
        score[4::6], score[5::6] = 7.0, np.nan
        index = 900 + np.tile(np.arange(6), len(own))
        origin = np.full(len(bad), FABRICATED, np.uint8)
        boxes = unchecked(listed.boxes, **{
            name: np.concatenate([getattr(listed.boxes, name), column])
            for name, column in (("xyz_m", xyz_m), ("lwh_m", lwh_m), ("yaw_rad", bad.boxes.yaw_rad))
        })  # fmt: skip
        bad = replace(bad, detection_index=index, score=score, origin=origin)
        columns = {
            f.name: np.concatenate([getattr(listed, f.name), getattr(bad, f.name)])
            for f in fields(Detections) if f.name != "boxes"
        }  # fmt: skip
        order = np.lexsort((columns["detection_index"], columns["observer"]))
        boxes = unchecked(boxes, **{f.name: getattr(boxes, f.name)[order] for f in fields(Boxes)})
        return Detections(boxes=boxes, **{name: column[order] for name, column in columns.items()})


class HostileMessages(TruPercept):
    """TruPercept that receives every evaluation message with nonsense added."""

    def add_evaluations(self, received):
        """Repeated and contradicting evaluations, of unknown detections and senders, and with impossible values."""
        m = received.messages
        n, index, evaluation, visibility = len(m.observer), m.detection_index, m.evaluation, m.visibility
        observer = np.concatenate([m.observer, m.observer, m.observer, m.observer + 10**6, m.observer])
        evaluator = np.tile(np.repeat(np.arange(len(m.evaluator)), np.diff(m.ptr)), 5)
        order = np.argsort(evaluator, kind="stable")
        hostile = EvaluationMessages(
            m.step, m.evaluator, 5 * m.ptr, observer[order],
            np.concatenate([index, index, index + 5000, index, index])[order],
            np.concatenate([evaluation, -evaluation, evaluation, evaluation, np.full(n, np.nan)])[order],
            np.concatenate([visibility, np.ones(n), visibility, visibility, np.full(n, 3.0)])[order],
        )  # fmt: skip
        super().add_evaluations(ReceivedEvaluations(hostile, received.holder, received.message_row, received.eta))


class Renumbered:
    """A pseudonym policy without changes: pseudonyms are numbered by first use, not by actor."""

    def changes(self, ages):
        """None."""
        return np.zeros(len(ages.age_s), bool)


class DuplicatingMedium(UnitDiskMedium):
    """A unit disk in which every evaluation message is received twice."""

    def broadcast(self, state, kind, *args):
        """Receptions of the second round, each twice."""
        state, happened = super().broadcast(state, kind, *args)
        if not kind:
            return state, happened
        twice = np.repeat(np.arange(len(happened.receptions.receiver)), 2)
        return state, replace(happened, receptions=happened.receptions.take(twice))
