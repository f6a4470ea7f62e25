"""An attack: attackers shift their detections to the east, and deny the detections of others."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [[attacks]] that belong to this attack."""

    east_m: float = 3.0  # shift [m]


class MyAttack:
    Params = Params

    def __init__(self, params):
        self.params = params

    # An attack has one or more of five methods: phantoms, detections, evaluations, identities, sending.

    def detections(self, listed, context):  # the detections of all vehicles; change only those of attackers
        rows = context.own_rows(listed)
        rows = rows[listed.detection_index[rows] > 0]  # index 0 is the vehicle's self report
        xyz_m = listed.boxes.xyz_m.copy()  # never change an argument: work on a copy
        xyz_m[rows, 0] += self.params.east_m
        return replace(listed, boxes=replace(listed.boxes, xyz_m=xyz_m))

    def evaluations(self, rows, detections, context):  # the evaluations that all vehicles send
        of_others = rows.evaluator != detections.observer[rows.detection]
        lies = context.attacker[rows.evaluator] & of_others
        return np.where(lies, -1.0, rows.evaluation), np.where(lies, 1.0, rows.visibility)
