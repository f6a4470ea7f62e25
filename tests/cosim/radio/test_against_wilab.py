"""The sidelink and 802.11p against WiLabV2Xsim, at the same positions and with its channel model; nothing is tuned.

A reference curve is the mean of the runs of 15 s at hand, one to three. Vehicles of one lane keep their link's
shadowing, and a pair that reserved the same resource loses many messages, so that such runs differ. What chance does to
the reference is taken from our own runs: as many of them as the reference has are compared with the others.

The bounds are those of the issue that asked for this comparison: a root mean square of 0.02 in reception and 10 % in
the gaps. Where chance alone exceeds it, the 95 % quantile of reception counts. For the gaps there are more runs of the
reference: several copies of the road, 100 km apart, in one.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd
import pytest
from numpy import ndarray

from tests.cosim.radio import wilab, wilab_11p
from tests.cosim.radio.wilab import Setting

verify = pytest.mark.verify
SETTINGS = {
    "nr": Setting(True, 80, 7, 350),
    "lte": Setting(False, 80, 3, 300),
    "nr40": Setting(True, 40, 7, 350),
    "lte40": Setting(False, 40, 3, 300),
    "nr80mcs11": Setting(True, 80, 11, 350),
    "lte80mcs7": Setting(False, 80, 7, 300),
    "nr80slow": Setting(True, 80, 7, 350, period=200),
    "lte80slow": Setting(False, 80, 3, 300, period=200),
    "nr40flat": Setting(True, 40, 7, 350, sigma_db=0.0),
    "lte40flat": Setting(False, 40, 3, 300, sigma_db=0.0),
    "nr40mcs11flat": Setting(True, 40, 11, 350, sigma_db=0.0),
    "nr40harqflat": Setting(True, 40, 11, 350, n_sent=2, sigma_db=0.0),
    "nr80flat": Setting(True, 80, 7, 350, sigma_db=0.0),
    "lte80mcs7flat": Setting(False, 80, 7, 300, sigma_db=0.0),
}
"""Settings by the name of the reference run; the first runs of `nr` and `lte` are those of the shared folder."""
N_SEEDS = 24
RANGES_M = (100, 300)
BOUNDS_MS = (105, 150, 205, 305, 405)


@dataclass(frozen=True)
class Runs:
    """R runs: packets received and all [R, bin], and numbers of gaps by length [R, range, ms]."""

    received: ndarray
    all: ndarray
    gaps: ndarray

    def ratio(self) -> ndarray:
        """Reception in bins of 10 m, all runs together."""
        return self.received.sum(0) / self.all.sum(0)

    def longer(self, within: int, bound_ms: int) -> ndarray:
        """Share of the gaps within a range that are longer, for each run."""
        return self.gaps[:, within, bound_ms + 1 :].sum(1) / self.gaps[:, within].sum(1)


@cache
def reference(name: str) -> Runs:
    """The runs of WiLabV2Xsim: those here and, for three of the names, that of the shared folder."""
    received, total, gaps = [], [], []
    if name in ("nr", "lte", "11p"):
        prr, delays = (wilab.WILAB / f"{name}-{what}.tsv" for what in ("prr", "update_delay"))
        if not prr.exists():
            pytest.skip(f"no reference data: {prr} is absent")
        rows, found = np.loadtxt(prr), np.loadtxt(delays)
        received.append(rows[:, 1])
        total.append(rows[:, 4])
        if name != "11p":
            gaps.append(_by_length(1000 * found[:, 0], np.array([found[:, 1], found[:, 1] + found[:, 3]])))
    here = wilab.HERE / f"{name}-prr.csv"
    for _, frame in pd.read_csv(here).groupby("seed") if here.exists() else ():
        received.append(frame.received.to_numpy())
        total.append(frame["all"].to_numpy())
    here = wilab.HERE / f"{name}-gaps.csv"
    for _, frame in pd.read_csv(here).groupby("seed") if here.exists() else ():
        counts = np.array([frame.get(f"within_{m}_m", np.zeros(len(frame))) for m in RANGES_M])
        gaps.append(_by_length(frame.gap_ms.to_numpy(), counts))
    n = min(map(len, total))
    return Runs(*(np.array([row[:n] for row in rows]) for rows in (received, total)), np.array(gaps))


def _by_length(gap_ms: ndarray, counts: ndarray) -> ndarray:
    """Numbers of gaps in bins of 1 ms; the reference names a bin by its upper end."""
    at = np.minimum(np.rint(gap_ms).astype(int), 2999)
    return np.array([np.bincount(at, row, 3000) for row in counts])


@cache
def ours(name: str) -> Runs:
    """As many runs of this medium."""
    runs = [wilab.simulate(SETTINGS[name], seed, RANGES_M) for seed in range(N_SEEDS)]
    gaps = [[np.bincount(np.minimum(np.rint(1000 * g).astype(int), 2999), minlength=3000) for g in run[2]]
            for run in runs]  # fmt: skip
    return Runs(np.array([run[0] for run in runs]), np.array([run[1] for run in runs]), np.array(gaps))


def rms(difference: ndarray) -> float:
    return float(np.sqrt(np.mean(difference**2)))


def compare(theirs: Runs, mine: Runs) -> tuple[float, float, float, float]:
    """RMSE of reception, the 95 % quantile of what chance makes of it, mean difference, and its standard error."""
    n, k, s = min(theirs.all.shape[1], mine.all.shape[1]), len(theirs.all), len(mine.all)
    assert n >= theirs.all.shape[1] - 1
    difference = (mine.ratio()[:n] - theirs.ratio()[:n]).copy()
    each, g, chance = mine.received[:, :n] / mine.all[:, :n], np.random.default_rng(1), []
    for _ in range(400):
        order = g.permutation(s)
        chance.append(each[order[:k]].mean(0) - each[order[k:]].mean(0))
    return (
        rms(difference), float(np.quantile([rms(c) for c in chance], 0.95)), float(difference.mean()),
        float(np.std([c.mean() for c in chance])),
    )  # fmt: skip


@verify
@pytest.mark.parametrize("name", SETTINGS)
def test_reception(name):
    rmse, chance, mean, error = compare(reference(name), ours(name))
    runs = len(reference(name).all)
    print(f"{name}: {runs} runs, RMSE {rmse:.4f}, chance {chance:.4f}, mean {mean:+.4f} +- {error:.4f}")
    assert rmse <= max(0.02, chance)
    assert abs(mean) <= 3 * error


@verify
def test_at_least_ten_configurations_are_within_two_hundredths():
    rmse = {name: compare(reference(name), ours(name))[0] for name in SETTINGS}
    assert sum(value <= 0.02 for value in rmse.values()) >= 10, rmse


def all_gaps(name: str) -> tuple[ndarray, int]:
    """Numbers of gaps by range and length in all runs of the reference, and how many runs; a copy counts as one."""
    gaps = reference(name).gaps
    counts, n = gaps.sum(0), len(gaps)
    here = wilab.HERE / f"{name}-copies-gaps.csv"
    if here.exists():
        frame = pd.read_csv(here)
        counts = counts + _by_length(
            frame.gap_ms.to_numpy(), np.array([frame.get(f"within_{m}_m", np.zeros(len(frame))) for m in RANGES_M])
        )
        n += frame.seed.nunique() * 400 // SETTINGS[name].n_vehicles
    return counts, n


def longer_as_there(mine: Runs, theirs: ndarray, within: int, bound_ms: int, period: int) -> ndarray:
    """Share of longer gaps in each run, with the rounding of the reference.

    There, a gap goes to the bin above with the share of the gaps of one interval that do.
    """
    up = theirs[within, period + 1] / theirs[within, period : period + 2].sum()
    return mine.longer(within, bound_ms) + up * mine.gaps[:, within, bound_ms] / mine.gaps[:, within].sum(1)


@verify
@pytest.mark.parametrize("name", SETTINGS)
def test_gaps(name):
    """Beyond one interval, gaps come from selections of another slot: some 240 in a run, which all receivers share."""
    theirs, n = all_gaps(name)
    mine, has_copies = ours(name), (wilab.HERE / f"{name}-copies-gaps.csv").exists()
    for within in range(2):
        if not theirs[within].any():
            continue
        for bound_ms in BOUNDS_MS:
            b = theirs[within, bound_ms + 1 :].sum() / theirs[within].sum()
            first = reference(name).longer(within, bound_ms).mean()
            if max(b, first) < 0.01 or b > 0.5:
                continue
            a = longer_as_there(mine, theirs, within, bound_ms, SETTINGS[name].period)
            spread = np.std(a, ddof=1)
            print(
                f"{name}, {RANGES_M[within]} m, {bound_ms} ms: {b:.5f} +- {spread / np.sqrt(n):.5f} in {n} runs there, "
                f"{a.mean():.5f} +- {spread / np.sqrt(len(a)):.5f}, {a.mean() / b - 1:+.3f}"
            )
            assert abs(a.mean() - b) <= 3 * spread * np.sqrt(1 / n + 1 / len(a))
            assert abs(a.mean() - b) <= 0.1 * b or not has_copies


@verify
def test_gaps_of_all_configurations_together():
    """Selections do not depend on the channel, so that the configurations at 10 Hz have the same share of long gaps."""
    names = [name for name in SETTINGS if "slow" not in name]
    theirs = np.concatenate([reference(name).longer(0, 105) for name in names])
    mine = np.concatenate([ours(name).longer(0, 105) for name in names])
    print(f"{len(theirs)} runs: {theirs.mean():.5f} +- {np.std(theirs) / np.sqrt(len(theirs)):.5f}, {mine.mean():.5f}")
    assert mine.mean() == pytest.approx(theirs.mean(), rel=0.1)


def mine_and_theirs_11p(n_seeds: int) -> tuple[Runs, Runs, Runs]:
    """The reference of 802.11p, our runs, and our transmissions as its receiver would receive them."""
    theirs = reference("11p")
    runs = [wilab_11p.simulate(seed, theirs.all.shape[1]) for seed in range(N_SEEDS)]
    ours_, as_theirs, total = (np.array([run[k] for run in runs]) for k in range(3))
    return theirs, Runs(ours_, total, np.zeros(0)), Runs(as_theirs, total, np.zeros(0))


@verify
def test_reception_of_11p():
    theirs, mine, as_theirs = mine_and_theirs_11p(N_SEEDS)
    for what, runs in (("our receiver", mine), ("their receiver", as_theirs)):
        rmse, chance, mean, error = compare(theirs, runs)
        print(f"11p, {what}: RMSE {rmse:.4f}, chance {chance:.4f}, mean {mean:+.4f} +- {error:.4f}")
        assert rmse <= 0.02
        assert abs(mean) <= 3 * error
