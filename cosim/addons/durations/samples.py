"""Durations of a run as they were observed: in intervals of a step, cut off at both ends of the observation."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.rows import Rows
from results.metrics.encounters import DEFINITION, Departure, durations, fewest_steps
from results.run import Run

What = Literal["duration", "inter_contact"]
"""Durations of encounters (of links, if the hysteresis is 0), or times between two encounters of a pair."""

LABELS: dict[What, str] = {"duration": "duration", "inter_contact": "inter-contact time"}

_COLUMNS = (
    *DEFINITION,
    "a",
    "b",
    "start_step",
    "end_step",
    "censored_left",
    "censored_right",
    "departed",
    "gap_s",
)


@dataclass(frozen=True, slots=True)
class Durations(Rows):
    """N durations that are known to lie in intervals, out of those that are long enough to be observed."""

    low_s: Float[ndarray, "n"]
    """It lasted at least this long."""
    high_s: Float[ndarray, "n"]
    """It lasted at most this long; infinite if its end was not observed."""
    entry_s: Float[ndarray, "n"]
    """A shorter one would not be in the sample (left truncation)."""
    a: Int[ndarray, "n"]
    b: Int[ndarray, "n"]
    """The two actors, on which others in the sample may depend."""
    step_s: float = 0.0
    """Length of the steps in which they were counted; 0 if they were timed."""

    def __post_init__(self) -> None:
        assert (self.low_s < self.high_s).all()
        assert (self.entry_s <= self.low_s).all() and (self.entry_s >= 0).all()

    def __len__(self) -> int:
        return len(self.low_s)

    @property
    def ended(self) -> Bool[ndarray, "n"]:
        """Whether the end was observed."""
        return np.isfinite(self.high_s)


def definitions(run: Run) -> pd.DataFrame:
    """The definitions of encounters of a run, one row each: the columns of `DEFINITION`."""
    found = run.table("encounters", [*DEFINITION])
    return found.drop_duplicates().sort_values(["radius_m", "hysteresis_s"]).reset_index(drop=True)


def of_run(run: Run, what: What, definition: pd.Series, departure: Departure = "ends") -> Durations:
    """Durations of encounters by one definition, or the times between them.

    Parameters
    ----------
    run
        An opened run.
    what
        Which durations.
    definition
        Values of the columns of `DEFINITION`, as a row of `definitions`.
    departure
        Whether an actor that leaves ends its encounters, or censors them. Between encounters a departure always
        censors: it is not known when the two would have met again.

    Notes
    -----
    A pair in contact in n steps of length d was so for between (n - 1) d and (n + 1) d. If steps fall anywhere in the
    contact with equal probability, a contact of length x has n steps or more with the probability that x + v is above
    n d - d/2, where v is uniform between -d/2 and d/2. So n steps stand for the interval of one step around n d, in
    which not x but x + v lies (`step_s`). Times between encounters are shorter than the hysteresis only if they were
    bridged, so they begin there.

    Encounters whose start was not observed are left out: of what lasted before, nothing is known. They are followed as
    in `results.metrics.encounters.durations`.
    """
    if what == "duration":
        return _durations(run, definition, departure)
    frame = _defined(run.table("encounters", _COLUMNS), definition)
    return _inter_contacts(frame, run, float(definition["hysteresis_s"]))


def _defined(frame: pd.DataFrame, definition: pd.Series) -> pd.DataFrame:
    for column in DEFINITION:
        frame = frame[frame[column] == definition[column]]
    return frame


def _durations(run: Run, definition: pd.Series, departure: Departure) -> Durations:
    frame = _defined(durations(run, departure), definition)
    steps = np.round(frame.lasted_s / run.dt_s) + ~frame.over  # cut off: it lasted for a step more at least
    frame = frame.assign(steps=steps)[frame.start_seen & (steps > 0)]
    n, over = frame.steps.to_numpy(float), frame.over.to_numpy(bool)
    return _in_steps(n, over, run.dt_s, 1, frame.a.to_numpy(), frame.b.to_numpy())


def _inter_contacts(frame: pd.DataFrame, run: Run, hysteresis_s: float) -> Durations:
    """Times between the encounters of pairs, the last one cut off where one of the two leaves or recording ends."""
    dt_s = run.dt_s
    fewest = int(fewest_steps(np.array([hysteresis_s]), dt_s)[0])
    pairs = frame.sort_values("start_step").groupby(["a", "b"])
    was_away = pairs.departed.shift(fill_value=False).reindex(frame.index)  # of a trace, actors leave and return
    again = frame[frame.gap_s.notna() & ~was_away.astype(bool)]
    seen = np.round(again.gap_s.to_numpy(float) / dt_s)
    last = pairs.last().reset_index()
    last = last[~last.censored_right & ~last.departed]
    last_step = run.table("vehicles", ["vehicle", "last_step"]).set_index("vehicle").last_step
    leaves_a = last_step.reindex(last.a).to_numpy()
    leaves_b = last_step.reindex(last.b).to_numpy()
    until = np.minimum(leaves_a, leaves_b) + 1
    open_steps = (until - last.end_step.to_numpy()).astype(float)
    known = open_steps >= fewest
    n = np.r_[seen, open_steps[known]]
    ended = np.arange(len(n)) < len(seen)
    last = last[known]
    a = np.r_[again.a.to_numpy(), last.a.to_numpy()]
    b = np.r_[again.b.to_numpy(), last.b.to_numpy()]
    return _in_steps(n, ended, dt_s, fewest, a, b)


def _in_steps(
    n: Float[ndarray, "n"],
    ended: Bool[ndarray, "n"],
    dt_s: float,
    fewest: int,
    a: ndarray,
    b: ndarray,
) -> Durations:
    """Durations of n steps, of which fewer than `fewest` are not seen."""
    low = (n - 0.5) * dt_s
    high = np.where(ended, (n + 0.5) * dt_s, np.inf)
    entry = np.full(len(n), (fewest - 0.5) * dt_s)
    return Durations(low, high, entry, a, b, dt_s)
