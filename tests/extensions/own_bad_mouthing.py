"""An attack on evaluations of one's own: whatever others detect is denied with full visibility."""

import numpy as np


class BadMouthing:
    """Evaluation -1 and visibility 1 for every detection of another vehicle."""

    def evaluations(self, rows, detections, context):
        denied = context.attacker[rows.evaluator] & (rows.evaluator != detections.observer[rows.detection])
        return np.where(denied, -1.0, rows.evaluation), np.where(denied, 1.0, rows.visibility)
