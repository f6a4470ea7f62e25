"""Figures of trust models on the evidence of `attack_evidence`.

`python -m tests.verification.twelve_attacks DEVELOPMENT TABLE FILE_OR_MODEL...` reads the folder DEVELOPMENT for
thresholds and the files (`.pickle`) for figures, prints these, and writes the counts behind them to TABLE.

For each case and model: the area under the ROC curve of the server's evaluated values at its broadcasts, of honest
subjects from the first attack on against attackers from their own first attack on, within each world
(`misbehaviour.auc`), and the shares of honest and of attacking values below a threshold: the one with a margin of
`thresholds_of`, from the development worlds. Intervals are 95 % intervals of the bootstrap over worlds. The
bound is that of `evidence.auc_bound` on the evaluations that the server received, as vehicles are counted, not values.
"""

import pickle
import sys
from collections import defaultdict
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd

from cosim.addons.benchmark.evidence import HONEST, EvidenceStream
from cosim.addons.benchmark.play import Script
from cosim.addons.evidence.auc_bound import _EDGES, _N_BINS, _N_OTHERS, area
from results.metrics.intervals import ClusteredEstimate, ratio
from tests.verification.attack_evidence import NEVER, rules_of
from trust.models import MODELS, params_of
from trust.params import KINDS, TrustParams

SHOWN = (
    "belief_graph", "beta_by_kind", "median_groups", "evaluator_trust", "miso_v", "dawid_skene", "trupercept", "beta",
    "subjective_logic", "mate",
)  # fmt: skip
START = 20


def values(name: str, script: Script) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Step, subject and value whenever the server computes trust, of subjects in use; processor time of the model."""
    trust = TrustParams(freshness_s=30.0, evidence=KINDS)
    own = {"evidence": KINDS} if "evidence" in getattr(MODELS[name].Params, "__dataclass_fields__", {}) else {}
    model = MODELS[name](params_of(MODELS[name], trust, own), script.dt_s)
    found, begin_s = [], process_time()
    for step, opened in enumerate(script.opened):
        for received in script.arrived[step]:
            model.add_evaluations(received)
        if script.due[step] and step >= START:
            scores = model.scores(step)
            at = np.flatnonzero(scores.is_evaluated & np.isin(scores.subject, opened[1]))
            found.append((np.full(len(at), step), scores.subject[at], scores.trust[at]))
        model.open_step(*opened)
    step, subject, trust_in = map(np.concatenate, zip(*found, strict=True))
    return step, subject, trust_in, process_time() - begin_s


def split(found: tuple, since: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values of honest subjects from the first attack of any on, and of attackers from their own on."""
    step, subject, trust, _ = found
    attacks, begin = since[subject] < NEVER, min(since.min(), 10**6) if since.min() < NEVER else START
    return trust[~attacks & (step >= begin)], trust[attacks & (step >= since[subject])]


def above(honest: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Pairs in the right order (ties half), and all pairs."""
    honest, pairs = np.sort(honest), len(honest) * len(other)
    return pairs - sum(np.searchsorted(honest, other, side).sum() for side in ("left", "right")) / 2, pairs


def bound(stream: EvidenceStream, since: np.ndarray) -> tuple[float, float]:
    """As `cosim.addons.evidence.auc_bound.bounds`, with roles known, from a recorded stream: pairs won, and pairs."""
    rows = pd.DataFrame({c: np.asarray(v, np.int64) for c, v in stream.evaluations.items()})
    rows = rows[rows.evaluator != rows.observer]
    said, kind = (rows.evaluation * rows.visibility / 1e4).to_numpy(), (rows.detection_index % len(KINDS)).to_numpy()
    value = kind * _N_BINS + np.searchsorted(_EDGES, said)
    _, claim = np.unique(
        rows[["detection_step", "observer", "detection_index"]].to_numpy(), axis=0, return_inverse=True
    )
    claim = claim.reshape(-1)
    n, total = np.bincount(claim)[claim] - 1, np.bincount(claim, said)[claim] - said
    others = np.where(n == 0, 0, np.where(total < 0, 1, 2))
    by, of, step = (rows[c].to_numpy() for c in ("evaluator", "observer", "step"))
    attacks, n_received = since < NEVER, len(KINDS) * _N_BINS * 2
    who = stream.pseudonyms["pseudonym"].astype(np.int64)
    best = (np.nan, 0.0)
    for known in (True, False):
        cells = (
            value * 2 + (attacks[by] & known),
            n_received + (value * _N_OTHERS + others) * 2 + (attacks[of] & known),
        )
        counts = np.zeros((int(who.max()) + 1, n_received * (1 + _N_OTHERS)), np.int64)
        begin = np.where(attacks, since, min(int(since.min()), 10**6))
        for subject, cell in zip((of, by), cells, strict=True):
            here = step >= begin[subject]
            np.add.at(counts, (subject[here], cell[here]), 1)
        has_clues = counts[who].any(axis=1)
        mine, vehicle = who[has_clues], stream.pseudonyms["vehicle"][has_clues]
        found = area(counts[mine][:, counts[mine].any(axis=0)], attacks[mine], vehicle)
        pairs = float(attacks[mine].sum() * (~attacks[mine]).sum())
        if np.isfinite(found.value) and not found.value * pairs <= best[0]:
            best = (found.value * pairs, pairs)
    return best if best[1] else (0.0, 0.0)


def table(files: list[Path], thresholds: dict[str, tuple[float, float]], models: tuple[str, ...]) -> pd.DataFrame:
    """A row per file, case and model: pairs won, pairs, and honest and attacking values, all and excluded."""
    rows, received, cost_s = [], 0, defaultdict(float)
    for path in files:
        n_steps, cases = pickle.loads(path.read_bytes())
        for case, stream, since in cases:
            script = Script.of(stream, rules_of(n_steps))
            received += sum(len(one) for step in script.arrived for one in step)
            attack, _, share = case.partition("=")
            world = {"world": path.stem, "attack": attack, "share_p": float(share or 0)}
            if attack != HONEST and since.min() < NEVER:
                won, pairs = bound(stream, since)
                rows.append(world | {"model": "bound", "won": won, "pairs": pairs})
            for name in models:
                found = values(name, script)
                cost_s[name] += found[-1]
                honest, other = split(found, since)
                won, pairs = above(honest, other)
                plain, low = thresholds.get(name, (np.nan, np.nan))
                rows.append(world | {
                    "model": name, "won": won, "pairs": pairs, "honest": len(honest),
                    "low_plain": (honest < plain).sum(), "low": (honest < low).sum(),
                    "attacking": len(other), "found": (other < low).sum(), "n_attackers": (since < NEVER).sum(),
                })  # fmt: skip
    print({name: f"{1e6 * s / received:.2f} us per received evaluation" for name, s in cost_s.items()})
    return pd.DataFrame(rows)


def estimate(of: pd.DataFrame, top: str, below: str) -> ClusteredEstimate:
    """Ratio of two columns, with its interval over worlds."""
    return ratio(of[top].to_numpy(float), of[below].to_numpy(float))


def thresholds_of(files: list[Path], models: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Two thresholds of each model: 5 % of its values without attack are below the first, and that with a margin.

    The second is the largest of the smallest values without attack for which, in every recorded case, the upper end of
    the 95 % interval over worlds of the excluded honest share is at most 5 %.
    """
    found: dict[str, dict[str, list[np.ndarray]]] = {name: defaultdict(list) for name in models}
    for path in files:
        n_steps, cases = pickle.loads(path.read_bytes())
        for case, stream, since in cases:
            script = Script.of(stream, rules_of(n_steps))
            for name in models:
                found[name][case].append(split(values(name, script), since)[0])
    return {name: (plain_of(of[HONEST]), margin_of(of)) for name, of in found.items()}


def plain_of(worlds: list[np.ndarray]) -> float:
    """The value below which 5 % of all values are."""
    return float(np.quantile(np.concatenate(worlds), 0.05))


def margin_of(cases: dict[str, list[np.ndarray]]) -> float:
    """The threshold with a margin, from the honest values of each case and world."""
    tried = np.unique(np.quantile(np.concatenate(cases[HONEST]), np.linspace(0.0, 0.05, 101)))
    n = {case: np.array([len(of) for of in worlds], float) for case, worlds in cases.items()}
    for low in tried[::-1]:
        below = {case: np.array([(of < low).sum() for of in worlds], float) for case, worlds in cases.items()}
        if not any(ratio(below[case], n[case]).high > 0.05 for case in cases):
            return float(low)
    return float(tried[0])


if __name__ == "__main__":
    development, out, *names = sys.argv[1:]
    developed = sorted(Path(development).glob("*.pickle"))
    models = tuple(name for name in names if name in MODELS) or SHOWN
    files = [Path(name) for name in names if name not in MODELS]
    both = thresholds_of(developed, models)
    print({name: [round(low, 4) for low in lows] for name, lows in both.items()})
    rows = table(files, both, models)
    rows.to_csv(out, index=False)
    for (share, attack, model), of in rows.groupby(["share_p", "attack", "model"], sort=False):
        auc = estimate(of, "won", "pairs") if attack != HONEST else None
        shares = (("low_plain", "honest"), ("low", "honest"), ("found", "attacking"))
        plain, low, hit = (estimate(of, a, b) if model != "bound" else None for a, b in shares)
        print(f"{share:g}", attack, model, *(
            "-" if e is None else f"{e.value:.3f} ({e.low:.3f} to {e.high:.3f})" for e in (auc, plain, low, hit)
        ), len(of))  # fmt: skip
