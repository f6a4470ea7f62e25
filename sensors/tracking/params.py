"""How vehicles track what they detect: parameters."""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt

from cosim.base.bounds import NotNegative1000, Positive1000

Positive = tuple[Positive1000, Positive1000, Positive1000, Positive1000]
"""One value per class: car, pedestrian, cyclist, truck."""
NotNegative = tuple[NotNegative1000, NotNegative1000, NotNegative1000, NotNegative1000]
_Share = Annotated[float, Gt(0), Lt(1)]
_LogOdds = Annotated[float, Ge(-100), Le(100)]


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingParams:
    """How every equipped vehicle tracks the objects that it detects.

    Tuples hold one value per class: car, pedestrian, cyclist, truck. The page on tracking says how the values were
    chosen.
    """

    model: Literal["none", "constant_velocity"] = "none"
    """`none`: detected objects have no velocity. `constant_velocity`: Kalman filters with nearly constant velocity."""
    steady_noise: Positive = (0.001, 0.002, 0.0005, 0.001)
    """Spectral density of the random acceleration of an object that keeps its velocity, along each axis [m2/s3]: by
    this much the variance of the velocity grows per second."""
    acceleration_noise: Positive = (2.5, 0.5, 0.6, 5.0)
    """That of an object that speeds up, brakes or turns [m2/s3]."""
    accelerating_p: Annotated[float, Ge(0), Lt(1)] = 0.2
    """Share of the time in which an object speeds up, brakes or turns."""
    motion_memory_s: Positive1000 = 2.0
    """After this time, 1/e of the objects have gone on as they moved without a chance to change [s]."""
    position_sigma_m: Positive = (0.08, 0.1, 0.07, 0.15)
    """Standard deviation of what is new in the error of a detection's position, along each axis [m]: a detector repeats
    a part of its error."""
    along_mean_mps: NotNegative = (6.0, 0.6, 3.0, 6.0)
    """Expected speed of a new track along the heading of its detection [m/s]."""
    along_sigma_mps: Positive = (4.5, 1.0, 3.0, 4.5)
    """Standard deviation of that speed [m/s]."""
    across_sigma_mps: Positive = (0.7, 1.0, 0.7, 0.7)
    """Standard deviation of the velocity across the heading [m/s]; its mean is 0."""
    own_speed_mean: NotNegative = (0.7, 0.0, 0.0, 0.7)
    """Share of the observer's own speed that the expected speed is at least where no map says the speed limit."""
    own_speed_sigma: NotNegative = (0.4, 0.0, 0.0, 0.4)
    """Share of the observer's own speed that the standard deviation of the speed is at least, likewise."""
    gate_p: _Share = 0.99
    """Probability that the next detection of a tracked object is inside the track's gate."""
    other_per_m2: Annotated[float, Gt(0), Le(1)] = 0.001
    """Density of the detections near a track that are not of its object, in one sweep [1/m2]. A detection may continue
    a track only if the track predicts it with a higher density."""
    confirm_hits: Annotated[int, Ge(1), Le(1000)] = 3
    """Number of detections from which on the object has a velocity."""
    keep_s: Positive1000 = 2.5
    """A track ends if its object is not detected for longer than this [s]. It must be at least as long as the interval
    between two sweeps."""
    existence_new: _LogOdds = 1.95
    """Log-odds that the object of a new track exists if the score is 0.5."""
    existence_again: _LogOdds = 1.38
    """Log-odds gained if it is detected again with a score of 0.5, long after the last time."""
    existence_score: NotNegative1000 = 1.9
    """Log-odds gained per log-odds of the score, in both cases."""
    existence_scores: tuple[_Share, _Share] = (0.18, 0.88)
    """Scores below and above these count as these."""
    existence_memory_s: NotNegative1000 = 1.5
    """Time over which a detector repeats its mistakes [s]. A detection t seconds after the last one counts by
    1 - exp(-t / existence_memory_s)."""

    def __post_init__(self) -> None:
        low, high = self.existence_scores
        if not low < high:
            raise ValueError(
                f"tracking.existence_scores = {self.existence_scores}: the first must be smaller than the second."
            )
