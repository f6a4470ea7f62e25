"""Slow literal twins of `sensors.tracking`: one observer and one track at a time, with whole matrices."""

from datetime import datetime, timedelta

import numpy as np
from scipy.optimize import linear_sum_assignment

GROUPS = ({0, 3}, {1, 2})
H = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])


def first_speed(label, limit_mps, own_mps, p):
    """Mean and standard deviation of the speed of a new track."""
    if limit_mps != limit_mps:
        shares, of_mps = (p.own_speed_mean[label], p.own_speed_sigma[label]), own_mps
    else:
        shares, of_mps = ((0.8, 0.6) if limit_mps * 3.6 > 80 else (0.5, 0.4)), limit_mps
        shares = shares if label in GROUPS[0] else (0.0, 0.0)
    return max(p.along_mean_mps[label], shares[0] * of_mps), max(p.along_sigma_mps[label], shares[1] * of_mps)


def measured(after_s):
    """The matrix that gives a place so many seconds later from a state (x, vx, y, vy)."""
    return np.array([[1.0, after_s, 0.0, 0.0], [0.0, 0.0, 1.0, after_s]])


def first_state(xy_m, yaw_rad, label, limit_mps, own_mps, p, after_s=0.0):
    """State (x, vx, y, vy) and covariance of a new track that was seen there so many seconds later."""
    mean, along = first_speed(label, limit_mps, own_mps, p)
    turn = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]])
    v = turn @ [mean, 0.0]
    spread = turn @ np.diag([along**2, p.across_sigma_mps[label] ** 2]) @ turn.T
    cov = np.zeros((4, 4))
    cov[np.ix_([1, 3], [1, 3])] = spread
    cov[0, 0] = cov[2, 2] = p.position_sigma_m[label] ** 2
    back, _ = motion(-after_s, 0.0)
    return back @ [xy_m[0], v[0], xy_m[1], v[1]], back @ cov @ back.T


def motion(dt, q):
    """Transition matrix and process noise."""
    f1, q1 = np.array([[1, dt], [0, 1]]), q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    both, zero = np.eye(2), np.zeros((2, 2))
    return np.kron(both, f1), np.block([[q1, zero], [zero, q1]])


def mixture(weights, states, covariances):
    """Mean and covariance of a mixture."""
    x = sum(w * one for w, one in zip(weights, states, strict=True))
    parts = zip(weights, states, covariances, strict=True)
    return x, sum(w * (cov + np.outer(one - x, one - x)) for w, one, cov in parts)


def independent(cov, yaw_rad):
    """The covariance without that between errors along and across this direction."""
    turn = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]])
    whole = np.kron(turn, np.eye(2))
    kept = np.kron(np.eye(2), np.ones((2, 2)))
    return whole @ (whole.T @ cov @ whole * kept) @ whole.T


def predict(t, dt, p):
    """Move a track by a time, by interacting multiple models."""
    share = np.array([1 - p.accelerating_p, p.accelerating_p])
    stay = np.exp(-dt / p.motion_memory_s)
    change = stay * np.eye(2) + (1 - stay) * share  # from each motion (rows) to each
    later, states, covariances = t["p"] @ change, [], []
    for j, noise in enumerate((p.steady_noise, p.acceleration_noise)):
        weights = t["p"] * change[:, j] / later[j] if later[j] else np.array([1.0, 0.0])
        x, cov = mixture(weights, t["x"], t["P"])
        f, q = motion(dt, noise[t["label"]])
        states.append(f @ x)
        covariances.append(f @ independent(cov, t["yaw"]) @ f.T + q)
    t["p"], t["x"], t["P"] = later, states, covariances


def density(t, h, xy, r):
    """Density of a detection under each motion of a track, and the squared distances."""
    values, squares = [], []
    for x, cov in zip(t["x"], t["P"], strict=True):
        s, y = h @ cov @ h.T + r, xy - h @ x
        squares.append(y @ np.linalg.inv(s) @ y)
        values.append(np.exp(-squares[-1] / 2) / (2 * np.pi * np.sqrt(np.linalg.det(s))))
    return np.array(values), np.array(squares)


class Twin:
    """All observers; `sense` is one call of `track` for one of them."""

    def __init__(self, params):
        self.p, self.tracks, self.count = params, {}, {}

    def sense(self, observer, time_s, own_mps, found):
        """`found` is a list of (label, xy, yaw, score, limit, after); returns (object_id, age, velocity, sum of
        its variances, existence)."""
        p = self.p
        keep_s = p.keep_s + 1e-9
        tracks = [t for t in self.tracks.get(observer, []) if time_s - t["last"] <= keep_s]
        for t in tracks:
            predict(t, time_s - t["time"], p)
            t["time"] = time_s
        cost = np.full((len(tracks), len(found) + len(tracks)), 1e9)
        for i, t in enumerate(tracks):
            cost[i, len(found) + i] = -2 * np.log(p.other_per_m2)
            for j, (label, xy, _, _, _, after_s) in enumerate(found):
                r = p.position_sigma_m[label] ** 2 * np.eye(2)
                values, squares = density(t, measured(after_s), xy, r)
                mean = t["p"] @ values
                if (
                    any({label, t["label"]} <= g for g in GROUPS)
                    and min(squares[t["p"] > 0]) < -2 * np.log(1 - p.gate_p)
                    and mean
                ):
                    cost[i, j] = -2 * np.log(mean)
        of = {j: tracks[i] for i, j in zip(*linear_sum_assignment(cost), strict=True) if j < len(found)}
        out = []
        for j, (label, xy, yaw, score, limit_mps, after_s) in enumerate(found):
            kept = min(max(score, p.existence_scores[0]), p.existence_scores[1])
            odds = p.existence_score * np.log(kept / (1 - kept))
            if j in of:
                t, h = of[j], measured(after_s)
                r = p.position_sigma_m[label] ** 2 * np.eye(2)
                likely = t["p"] * density(t, h, xy, r)[0]
                t["p"] = likely / likely.sum()
                for k, (x, cov) in enumerate(zip(t["x"], t["P"], strict=True)):
                    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
                    t["x"][k], t["P"][k] = x + gain @ (xy - h @ x), (np.eye(4) - gain @ h) @ cov
                weight = 1 - np.exp(-(time_s - t["last"]) / p.existence_memory_s)
                t["odds"] += weight * (p.existence_again + odds)
                t["hits"], t["last"], t["label"] = t["hits"] + 1, time_s, label
            else:
                x, cov = first_state(xy, yaw, label, limit_mps, own_mps, p, after_s)
                number = self.count.get(observer, 0)
                self.count[observer] = number + 1
                t = {"x": [x, x], "P": [cov, cov], "p": np.array([1 - p.accelerating_p, p.accelerating_p]), "yaw": yaw,
                     "time": time_s, "first": time_s, "last": time_s, "label": label, "hits": 1,
                     "odds": p.existence_new + odds, "id": number}  # fmt: skip
                tracks.append(t)
            x, cov = mixture(t["p"], t["x"], t["P"])
            v = x[[1, 3]] if t["hits"] >= p.confirm_hits else np.full(2, np.nan)
            out.append(
                (t["id"], time_s - t["first"], v, np.trace(cov[np.ix_([1, 3], [1, 3])]), 1 / (1 + np.exp(-t["odds"])))
            )
        self.tracks[observer] = tracks
        return out


class StoneSoup:
    """One observer's tracks by the library Stone Soup: its predictor, updater, hypothesiser and 2D assignment.

    The library has no interacting models. All objects have `steady_noise`, as with `accelerating_p` = 0.

    The library's track initiators and deleters differ from ours by design, so tracks begin and end by our rules.
    """

    def __init__(self, params):
        from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
        from stonesoup.hypothesiser.distance import DistanceHypothesiser
        from stonesoup.measures import Measure, SquaredMahalanobis
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
        from stonesoup.predictor.kalman import KalmanPredictor
        from stonesoup.updater.kalman import KalmanUpdater

        squared = SquaredMahalanobis(state_covar_inv_cache_size=None)

        class LogLikelihood(Measure):
            def __call__(self, prediction, detection):
                d2 = squared(prediction, detection)
                inside = d2 < -2 * np.log(1 - params.gate_p)
                return d2 + np.log(np.linalg.det(prediction.covar)) if inside else np.inf

        self.p, self.tracks, self.count = params, [], 0
        self.updater = KalmanUpdater(None)
        self.models = [LinearGaussian(4, (0, 2), s**2 * np.eye(2)) for s in params.position_sigma_m]
        self.by_class = []
        for q in params.steady_noise:
            moves = CombinedLinearGaussianTransitionModel([ConstantVelocity(q), ConstantVelocity(q)])
            self.by_class.append(DistanceHypothesiser(
                KalmanPredictor(moves), self.updater, LogLikelihood(),
                missed_distance=-2 * np.log(2 * np.pi * params.other_per_m2),
            ))  # fmt: skip
        self.associator = GNNWith2DAssignment(self)

    def hypothesise(self, track, detections, timestamp, **kwargs):
        """By the motion of the track's class."""
        return self.by_class[track.metadata["label"]].hypothesise(track, detections, timestamp, **kwargs)

    def sense(self, time_s, own_mps, found):
        """`found` is a list of (label, xy, yaw, score, limit); returns (object_id, position, velocity, hits)."""
        from stonesoup.types.detection import Detection
        from stonesoup.types.state import GaussianState
        from stonesoup.types.track import Track
        from stonesoup.types.update import Update

        p, now = self.p, datetime(2026, 1, 1) + timedelta(seconds=time_s)
        keep_s = p.keep_s + 1e-9
        self.tracks = [t for t in self.tracks if time_s - t.metadata["last"] <= keep_s]
        seen = [
            Detection(xy, timestamp=now, measurement_model=self.models[label], metadata={"label": label})
            for label, xy, _, _, _ in found
        ]
        of = {}
        for group in GROUPS:
            mine = [d for d in seen if d.metadata["label"] in group]
            theirs = {t for t in self.tracks if t.metadata["label"] in group}
            for t, hypothesis in self.associator.associate(theirs, mine, now).items():
                if hypothesis:
                    t.append(self.updater.update(hypothesis))
                    of[id(hypothesis.measurement)] = t
                else:
                    t.append(hypothesis.prediction)
        out = []
        for (label, xy, yaw, _, limit_mps), d in zip(found, seen, strict=True):
            t = of.get(id(d))
            if t is None:
                x, cov = first_state(xy, yaw, label, limit_mps, own_mps, p)
                t = Track([GaussianState(x[:, None], cov, timestamp=now)])
                t.metadata.update({"id": self.count, "hits": 0})
                self.count += 1
                self.tracks.append(t)
            else:
                assert isinstance(t[-1], Update)
            t.metadata.update({"label": label, "last": time_s, "hits": t.metadata["hits"] + 1})
            x = np.asarray(t.state_vector, float).ravel()
            out.append((t.metadata["id"], x[[0, 2]], x[[1, 3]], t.metadata["hits"]))
        return out
