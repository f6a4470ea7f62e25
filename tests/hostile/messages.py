"""An attack of a user's own that sends nonsense: what no message can hold, and what no attack may do."""

from dataclasses import dataclass, fields, replace

import numpy as np

from cosim.attacks.attack import Sending
from cosim.messages.content import FABRICATED, Detections
from sensors.boxes import Boxes

ODD = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1e-300, -1.0, 7.0, 1e6, 3e8, 1e155, -1e155, 1.7e308])
NUMBERS = np.array([-(2**63), -(2**31), -1, 0, 1, 2, 255, 2**15 - 1, 2**15, 2**16, 2**31, 2**40, 2**63 - 1])
IDENTITIES = np.array([0, 0, 0, 1, 2, 65535, 65536, -1, 10**9])
FEW, MANY = 4, 5000


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of its [[attacks]] section."""

    case: int = 0
    """Seed of what it does."""
    kind: str = "content"
    """content: wrong values; many: 5,000 boxes; hooks: nonsense from the other hooks; rows: rows that are nobody's."""


def unchecked(xyz_m, lwh_m, yaw_rad):
    """Boxes past the check of their constructor."""
    made = object.__new__(Boxes)
    for name, column in zip(("xyz_m", "lwh_m", "yaw_rad"), (xyz_m, lwh_m, yaw_rad), strict=True):
        object.__setattr__(made, name, column)
    return made


class Nonsense:
    """Adds detections with columns that cannot be."""

    Params = Params

    def __init__(self, params):
        self.params = params

    def _rng(self, context):
        return np.random.default_rng((self.params.case, context.world.step))

    def detections(self, listed, context):
        """The lists, with rows added; every added column is odd with some probability."""
        rng, kind = self._rng(context), self.params.kind
        own = np.flatnonzero((listed.detection_index == 0) & context.attacker[listed.observer])
        if kind == "hooks" or not len(own):
            return listed
        bad = listed.take(np.repeat(own, MANY if kind == "many" else FEW))
        n, share = len(bad), rng.choice([0.1, 0.5, 1.0]) if kind != "many" else rng.choice([0.0, 0.02])

        def odd(column, values):
            chosen = rng.random(np.shape(column)) < share * rng.choice([0.0, 0.3, 1.0])
            picked = rng.choice(values, np.shape(column))
            return np.where(chosen, picked, column)

        boxes = unchecked(odd(bad.boxes.xyz_m, ODD), odd(bad.boxes.lwh_m, ODD), odd(bad.boxes.yaw_rad, ODD))
        index = np.tile(np.arange(n // len(own)), len(own)) + int(listed.detection_index.max()) + 1
        more = {
            "detection_index": odd(index, NUMBERS), "label": odd(bad.label, np.array([4, 5, 255])).astype(np.uint8),
            "score": odd(bad.score, ODD), "n_points": odd(bad.n_points.astype(np.int64), NUMBERS), "target": bad.target,
            "origin": np.full(n, FABRICATED, np.uint8), "transmitted": odd(bad.transmitted, [False]).astype(bool),
            "identity": bad.identity, "speed_mps": odd(bad.speed_mps, ODD),
            "acceleration_mps2": odd(bad.acceleration_mps2, ODD), "observer": bad.observer,
            "velocity_mps": odd(bad.velocity_mps, ODD),
        }  # fmt: skip
        if kind == "rows":
            name = rng.choice(["observer", "target", "identity", "origin", "sort", "lose"])
            if name == "lose":
                return listed.take(np.flatnonzero(rng.random(len(listed)) < 0.5))
            if name == "identity":
                more["identity"] = odd(bad.identity, IDENTITIES)
            elif name == "origin":
                more["origin"] = odd(more["origin"], np.array([3, 200])).astype(np.uint8)
            elif name != "sort":
                more[name] = odd(more[name], np.array([-5, len(context.world), 10**6, 2**40]))
        bad = replace(bad, boxes=boxes, **more)
        columns = {
            f.name: np.concatenate([getattr(listed, f.name), getattr(bad, f.name)])
            for f in fields(Detections) if f.name != "boxes"
        }  # fmt: skip
        names = [f.name for f in fields(Boxes)]
        joined = [np.concatenate([getattr(listed.boxes, name), getattr(boxes, name)]) for name in names]
        order = rng.permutation(len(columns["observer"]))
        if kind != "rows":
            order = np.lexsort((columns["detection_index"], columns["identity"], columns["observer"]))
        return Detections(
            boxes=unchecked(*(c[order] for c in joined)), **{name: column[order] for name, column in columns.items()}
        )

    def evaluations(self, rows, detections, context):
        """Their own, some of them odd."""
        rng, n = self._rng(context), len(rows.evaluation)
        if self.params.kind != "hooks":
            return rows.evaluation, rows.visibility
        mine = context.attacker[rows.evaluator] & (rng.random(n) < 0.7)
        one, other = (np.where(mine, rng.choice(ODD, n), column) for column in (rows.evaluation, rows.visibility))
        how = rng.choice(["odd", "odd", "short", "none"])
        return {"odd": (one, other), "short": (one[:-1], other), "none": None}[str(how)]

    def identities(self, context):
        """Further ones, or nonsense."""
        n, rng = len(context.world), self._rng(context)
        if self.params.kind != "hooks" or self.params.case % 3:
            return np.zeros(n, np.int64)
        return rng.choice([0, 1, 2, -1, 300, 10**6, 2**40], n) * context.attacker

    def sending(self, context):
        """Plain, or nonsense."""
        n, rng = len(context.world), self._rng(context)
        if self.params.kind != "hooks" or self.params.case % 3 != 1:
            return Sending.plain(n)
        copies = rng.choice([0, 1, -1, 300, 10**9, 2**62], n)
        mine, odd = copies * context.attacker, np.where(context.attacker, rng.choice(ODD, n), 0.0)
        noise = np.where(context.attacker, odd, -np.inf)
        return Sending(odd, mine, mine, jam_dbm=noise, react_dbm=noise, ignores_dcc=mine > 0)
