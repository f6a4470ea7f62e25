"""Path loss, blockage by vehicles, shadowing and fading at 5.9 GHz: from positions to mean received power.

Nomenclature: d is the distance [m], f the carrier [GHz]; losses are positive [dB]. Shadowing and blockage depend on the
*positions* of the two ends, and are the same for all packets. Fading is different for each packet and receiver: this
file gives each link a class of Nakagami fading, from which the event loop draws.

References
----------
.. [1] 3GPP TR 37.885, "Study on evaluation methodology of new V2X use cases for LTE and NR", section 6.2.
.. [2] C. Sommer, F. Dressler, "Using the right two-ray model?", MobiCom posters 2011.
.. [3] L. Cheng et al., "Mobile vehicle-to-vehicle narrow-band channel measurement and characterization of the
   5.9 GHz DSRC frequency band", IEEE JSAC 25(8), 2007.
.. [4] C. Sommer, D. Eckhoff, R. German, F. Dressler, "A computationally inexpensive empirical model of
   IEEE 802.11p radio shadowing in urban environments", WONS 2011.
.. [5] M. Boban, X. Gong, W. Xu, "Modeling the evolution of line-of-sight blockage for V2V channels", VTC 2016.
"""

from dataclasses import dataclass
from functools import cache
from typing import Annotated, Literal

import numpy as np
import scipy
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.bounds import NotNegative1000
from cosim.base.hash_rng import mix, unit
from cosim.base.kernel import compiled, inlined, kernel
from cosim.base.threads import in_ranges

LIGHT_MPS = 299_792_458.0
BLOCKER_M = 1.6
"""Height of a car that blocks a link [1]_ [m]; a truck is 3 m high."""

FADING: dict[str, tuple[tuple[float, float], ...]] = {
    "none": (),
    "nakagami": ((80.0, 1.5), (np.inf, 0.75)),
    "rayleigh": ((np.inf, 1.0),),
    "cheng": ((4.7, 3.01), (11.7, 1.18), (28.9, 1.94), (71.6, 1.86), (177.3, 0.45), (np.inf, 0.32)),
}
"""Nakagami shape m up to each distance [m]: ns-3's and Veins' default; m = 1; set 2 of [3]_ as Artery has it."""
_FIRST_CLASSES = np.cumsum([1] + [len(rows) for rows in FADING.values()])
_FIRST_CLASS = dict(zip(FADING, _FIRST_CLASSES, strict=False))

Model = Literal[
    "free_space", "two_ray_interference", "two_ray_ground", "log_distance", "dual_slope", "urban", "highway"
]


@dataclass(frozen=True, kw_only=True, slots=True)
class PropagationParams:
    """Propagation between two antennas."""

    model: Model = "urban"
    """Path loss; `urban` and `highway` are those of 3GPP TR 37.885, with line of sight and blockage."""
    frequency_ghz: Annotated[float, Gt(0.5), Le(6)] = 5.9
    """Carrier [GHz]."""
    tx_power_dbm: Annotated[float, Ge(-20), Le(33)] = 23.0
    """Transmitted power, antenna gains included [dBm]."""
    exponent: Annotated[float, Gt(0), Le(10)] = 2.75
    """Path loss exponent of `log_distance`."""
    near_exponent: Annotated[float, Gt(0), Le(10)] = 2.0
    """Path loss exponent of `dual_slope` up to the break point."""
    far_exponent: Annotated[float, Gt(0), Le(10)] = 4.0
    """Path loss exponent of `dual_slope` beyond the break point."""
    break_m: Annotated[float, Gt(1), Le(100_000)] = 100.0
    """Break point of `dual_slope` [m]."""
    permittivity: Annotated[float, Gt(1), Le(100)] = 1.02
    """Relative permittivity of the road, for `two_ray_interference`."""
    walls: Literal["3gpp", "sommer"] = "3gpp"
    """Loss without line of sight: the path loss of TR 37.885 (`urban` and `highway` only), or per wall and metre."""
    wall_db: NotNegative1000 = 9.0
    """Loss per wall crossed, for `sommer` [dB]."""
    indoors_db_per_m: NotNegative1000 = 0.4
    """Loss per metre inside buildings, for `sommer` [dB/m]."""
    shadowing: bool = True
    """Whether links are shadowed."""
    sigma_los_db: Annotated[float, Ge(0), Le(50)] = 3.0
    """Standard deviation of shadowing with line of sight by buildings [dB]."""
    sigma_nlos_db: Annotated[float, Ge(0), Le(50)] = 4.0
    """Standard deviation of shadowing without line of sight [dB]."""
    decorrelation_los_m: Annotated[float, Ge(0.1), Le(10_000)] = 10.0
    """Movement of one end that reduces the correlation of shadowing to 1/e, line of sight [m]; 25 on highways."""
    decorrelation_nlos_m: Annotated[float, Ge(0.1), Le(10_000)] = 13.0
    """Movement of one end that reduces the correlation of shadowing to 1/e, otherwise [m]; 25 on highways."""
    blockage: Literal["none", "probabilistic", "bodies"] = "probabilistic"
    """Blockage by vehicles of links with line of sight by buildings (urban and highway models). `probabilistic`: drawn
    from the positions of the two ends. `bodies`: by the boxes of all road users between them, equipped or not."""
    traffic: Literal["low", "medium", "high"] = "medium"
    """Density of traffic, for probabilistic blockage."""
    fading: Literal["none", "nakagami", "rayleigh", "cheng"] = "nakagami"
    """Fading per packet and receiver."""
    interference_range_m: Annotated[float, Gt(0), Le(100_000)] = 1000.0
    """Longer links are neglected, as interference too [m]."""
    interference_range_nlos_m: Annotated[float, Gt(0), Le(100_000)] = 300.0
    """Longer links without line of sight are neglected, as interference too [m]."""
    cutoff_dbm: Annotated[float, Ge(-140), Le(-60)] = -110.0
    """Links of less mean power are neglected, as interference too [dBm]."""

    @property
    def knows_walls(self) -> bool:
        """Whether buildings have an effect in these models."""
        return self.walls == "sommer" or self.model in ("urban", "highway")

    def __post_init__(self) -> None:
        if self.interference_range_m < 5:
            raise ValueError(
                f"radio.propagation.interference_range_m = {self.interference_range_m:g} m is shorter than a vehicle: "
                "no link remains. "
                "Metres, not kilometres? Set radio.propagation.interference_range_m to at least 5."
            )


def free_space_db(d: Float[ndarray, "m"], f: float = 5.9) -> Float[ndarray, "m"]:
    """Loss of free space: 20 log(4 pi d / lambda); 47.86 dB at 1 m and 5.9 GHz.

    Parameters
    ----------
    d
        Distance [m], above 0.
    f
        Carrier [GHz].
    """
    hz = f * 1e9
    return 20 * np.log10(4 * np.pi * d * hz / LIGHT_MPS)


def two_ray_ground_db(
    d: Float[ndarray, "m"],
    h_a_m: Float[ndarray, "m"],
    h_b_m: Float[ndarray, "m"],
    f: float = 5.9,
) -> Float[ndarray, "m"]:
    """Loss of free space up to the distance 4 pi h_a h_b / lambda, then 40 log d - 20 log(h_a h_b).

    Parameters
    ----------
    d, f
        As for `free_space_db`.
    h_a_m, h_b_m
        Heights of the two antennas above the street.
    """
    cross = 4 * np.pi * h_a_m * h_b_m * f * 1e9 / LIGHT_MPS
    far_db = 40 * np.log10(d) - 20 * np.log10(h_a_m * h_b_m)
    return np.where(d <= cross, free_space_db(d, f), far_db)


def two_ray_interference_db(
    d: Float[ndarray, "m"],
    h_a_m: Float[ndarray, "m"],
    h_b_m: Float[ndarray, "m"],
    f: float = 5.9,
    permittivity: float = 1.02,
) -> Float[ndarray, "m"]:
    """Loss with the direct ray and its reflection on the road, added by phase [2]_.

    Parameters
    ----------
    d
        Horizontal distance [m], above 0.
    h_a_m, h_b_m
        Heights of the two antennas above the street.
    f
        Carrier [GHz].
    permittivity
        Relative permittivity of the road.

    Returns
    -------
    Loss [dB]. It is below that of free space where the two rays add up.
    """
    direct = np.hypot(d, h_a_m - h_b_m)
    reflected = np.hypot(d, h_a_m + h_b_m)
    sine, cosine = (h_a_m + h_b_m) / reflected, d / reflected
    root = np.sqrt(permittivity - cosine**2)
    gamma = (sine - root) / (sine + root)
    phase = 2 * np.pi * (direct - reflected) * f * 1e9 / LIGHT_MPS
    gain = np.abs(1 + gamma * np.exp(1j * phase))
    return free_space_db(d, f) - 20 * np.log10(gain)


def log_distance_db(d: Float[ndarray, "m"], exponent: float = 2.75, f: float = 5.9) -> Float[ndarray, "m"]:
    """Loss of free space at 1 m, plus 10 n log d.

    Parameters
    ----------
    d, f
        As for `free_space_db`.
    exponent
        Path loss exponent n.
    """
    return free_space_db(np.ones(()), f) + 10 * exponent * np.log10(d)


def dual_slope_db(
    d: Float[ndarray, "m"], near: float = 2.0, far: float = 4.0, break_m: float = 100.0, f: float = 5.9
) -> Float[ndarray, "m"]:
    """Loss of `log_distance_db`, with another exponent beyond the break point [3]_.

    Parameters
    ----------
    d, f
        As for `free_space_db`.
    near, far
        Path loss exponents up to the break point and beyond it.
    break_m
        Distance of the break point.
    """
    first = log_distance_db(np.minimum(d, break_m), near, f)
    return first + 10 * far * np.log10(np.maximum(d / break_m, 1.0))


def tr37885_db(
    d: Float[ndarray, "m"],
    nlos: Bool[ndarray, "m"],
    scenario: Literal["urban", "highway"],
    f: float = 5.9,
) -> Float[ndarray, "m"]:
    """Path loss of [1]_, without blockage by vehicles (see `blockage_db`).

    Parameters
    ----------
    d, f
        As for `free_space_db`.
    nlos
        Whether a building blocks the line of sight. The loss is then the same in both scenarios.
    """
    log_d, log_f = np.log10(d), np.log10(f)
    if scenario == "urban":
        los_db = 38.77 + 16.7 * log_d + 18.2 * log_f
    else:
        los_db = 32.4 + 20 * log_d + 20 * log_f
    nlos_db = 36.85 + 30 * log_d + 18.9 * log_f
    return np.where(nlos, nlos_db, los_db)


HEIGHT_STEP_M = 0.001
"""Heights are compared as whole millimetres [m]: 1.5 m + 0.1 m is 1.6 m, however the sum is rounded."""


def blockage_mean_db(
    d: Float[ndarray, "m"],
    h_a_m: Float[ndarray, "m"],
    h_b_m: Float[ndarray, "m"],
    blocker_m: float | Float[ndarray, "m"] = BLOCKER_M,
) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
    """Mean and standard deviation of the loss behind a vehicle (NLOSv), by antenna heights [1]_.

    Parameters
    ----------
    d
        Distance [m].
    h_a_m, h_b_m
        Heights of the two antennas above the street [m].
    blocker_m
        Height of the blocking vehicle above the street [m].

    Returns
    -------
    Mean and standard deviation [dB]; 0 and 0 where nothing is lost.

    Notes
    -----
    Both antennas higher than the blocker: no loss. Both lower: mean 9 + max(0, 15 log d - 41), deviation 4.5.
    Otherwise, equal heights included: mean 5 + max(0, 15 log d - 41), deviation 4.   Deviations: heights are rounded
    to a millimetre before they are compared.
    """
    blocker = np.rint(np.asarray(blocker_m) / HEIGHT_STEP_M)
    a = np.rint(np.asarray(h_a_m) / HEIGHT_STEP_M)
    b = np.rint(np.asarray(h_b_m) / HEIGHT_STEP_M)
    clear = np.minimum(a, b) > blocker
    both = np.maximum(a, b) < blocker
    farther = np.maximum(0.0, 15 * np.log10(d) - 41)
    mean = np.where(both, 9.0, 5.0) + farther
    deviation = np.where(both, 4.5, 4.0)
    return np.where(clear, 0.0, mean), np.where(clear, 0.0, deviation)


def blockage_db(
    normal: Float[ndarray, "m"],
    d: Float[ndarray, "m"],
    h_a_m: Float[ndarray, "m"],
    h_b_m: Float[ndarray, "m"],
    blocker_m: float | Float[ndarray, "m"] = BLOCKER_M,
) -> Float[ndarray, "m"]:
    """Loss behind a vehicle (NLOSv), log-normal with the moments of `blockage_mean_db` [1]_.

    Parameters
    ----------
    normal
        Standard normal value of the link.
    d, h_a_m, h_b_m, blocker_m
        As for `blockage_mean_db`.

    Returns
    -------
    Loss [dB]; 0 where both antennas are higher than the blocking vehicle.

    Notes
    -----
    Deviations: none beyond those of `blockage_mean_db`.
    """
    mean, deviation = blockage_mean_db(d, h_a_m, h_b_m, blocker_m)
    lossy = mean > 0
    mean = np.where(lossy, mean, 1.0)
    spread = np.log1p((deviation / mean) ** 2)  # variance of the logarithm
    log_loss = np.log(mean) - spread / 2 + np.sqrt(spread) * normal
    return np.where(lossy, np.exp(log_loss), 0.0)


_BOBAN_URBAN = {
    "low": (0.8548, 0.0064, 0.0396, 5.2718, 3.4827),
    "medium": (0.8372, 0.0114, 0.0312, 5.0063, 2.4544),
    "high": (0.8962, 0.0170, 0.0242, 5.0115, 2.2092),
}
_BOBAN_HIGHWAY = {"low": (1.5e-6, -0.0015), "medium": (2.7e-6, -0.0025), "high": (3.2e-6, -0.003)}


def vehicle_blockage_p(
    d: Float[ndarray, "m"], scenario: Literal["urban", "highway"], traffic: Literal["low", "medium", "high"]
) -> Float[ndarray, "m"]:
    """Probability that a vehicle blocks a link with line of sight by buildings: P(NLOSv) / (P(LOS) + P(NLOSv)) of [5]_.

    Parameters
    ----------
    d
        Distance [m], above 0.
    scenario, traffic
        Surroundings and density of traffic for which [5]_ fits a curve.

    Notes
    -----
    Deviations: beyond 475 m the highway parabola, which would rise again, stays at its minimum.
    """
    if scenario == "urban":
        p0, rate, a, b, c = _BOBAN_URBAN[traffic]
        los = np.minimum(1.0, p0 * np.exp(-rate * d))
        exponent = -((np.log(d) - b) ** 2) / c
        curve = np.exp(exponent) / (a * d)
        blocked = np.minimum(1 - los, curve)
        return blocked / (los + blocked)
    a, b = _BOBAN_HIGHWAY[traffic]
    d = np.minimum(d, -b / (2 * a))
    los = a * d**2 + b * d + 1
    return 1 - np.clip(los, 0, 1)


def mean_loss_db(
    d: Float[ndarray, "m"],
    nlos: Bool[ndarray, "m"],
    h_a_m: Float[ndarray, "m"],
    h_b_m: Float[ndarray, "m"],
    params: PropagationParams,
) -> Float[ndarray, "m"]:
    """Path loss of links by the chosen model [dB], before shadowing and blockage.

    Parameters
    ----------
    d
        Length of each link in space [m]. Lengths below 1 m count as 1 m.
    nlos
        Whether a building blocks the line of sight. It has an effect only in the urban and highway models.
    h_a_m, h_b_m
        Heights of the two antennas above the street. They have an effect only in the two-ray models.

    Notes
    -----
    Deviations: `two_ray_interference_db` gets the length in space in place of the horizontal distance.
    """
    d, f = np.maximum(d, 1.0), params.frequency_ghz
    match params.model:
        case "free_space":
            return free_space_db(d, f)
        case "two_ray_ground":
            return two_ray_ground_db(d, h_a_m, h_b_m, f)
        case "two_ray_interference":
            return two_ray_interference_db(d, h_a_m, h_b_m, f, params.permittivity)
        case "log_distance":
            return log_distance_db(d, params.exponent, f)
        case "dual_slope":
            return dual_slope_db(d, params.near_exponent, params.far_exponent, params.break_m, f)
    return tr37885_db(d, nlos, params.model, f)


def fading_class(d: Float[ndarray, "m"], fading: str) -> UInt8[ndarray, "m"]:
    """Row of `fading_quantiles` for each link.

    Parameters
    ----------
    d
        Length of each link [m].
    fading
        Key of `FADING`.
    """
    rows = FADING[fading]
    if not rows:
        return np.zeros(len(d), np.uint8)
    bounds = np.array([upper for upper, _ in rows[:-1]])
    return (_FIRST_CLASS[fading] + np.searchsorted(bounds, d)).astype(np.uint8)


@cache
def fading_quantiles() -> Float[ndarray, "classes 4096"]:
    """Power gain of each class of fading at 4096 equally likely levels.

    Returns
    -------
    Gains with mean 1, ascending in each row. Row 0 does not fade: all its gains are 1. The other rows are the Nakagami
    shapes of `FADING`, in order. The array is read-only.
    """
    level = (np.arange(4096) + 0.5) / 4096
    shapes = [m for rows in FADING.values() for _, m in rows]
    gains = [scipy.special.gammaincinv(m, level) / m for m in shapes]
    table = np.array([np.ones(4096), *gains], np.float32)
    table.flags.writeable = False
    return table


N_WAVES = 32


@inlined
def _sine_of_turns(x):
    """sin(2 pi x), to 4e-6."""
    r = x - np.floor(x + 0.5)
    if r > 0.25:
        r = 0.5 - r
    elif r < -0.25:
        r = -0.5 - r
    y = np.float32(2 * np.pi * r)
    z = y * y
    s = np.float32(-1 / 5040) + z * np.float32(1 / 362880)
    s = np.float32(1 / 120) + z * s
    s = np.float32(-1 / 6) + z * s
    return y + y * z * s


@compiled
def _waves(xy, decorrelation_m, rng_key):
    """Hashed plane waves at each position, in turns: cosine and sine of the phase of either end."""
    n = xy.shape[0]
    turns = np.empty((5, N_WAVES))  # per metre of x and y of the first end, then of the second; phase
    for k in range(N_WAVES):
        h = mix(rng_key, np.uint64(k))
        # A Cauchy wave vector in four dimensions, whose characteristic function is exp(-|x| / D).
        normal = np.empty(5)
        for i in range(5):
            u = unit(mix(h, np.uint64(2 * i)))
            v = unit(mix(h, np.uint64(2 * i + 1)))
            radius = np.sqrt(-2 * np.log(1 - u))
            normal[i] = radius * np.cos(2 * np.pi * v)
        scale = abs(normal[4]) * decorrelation_m * 2 * np.pi
        for i in range(4):
            turns[i, k] = normal[i] / scale
        turns[4, k] = unit(mix(h, np.uint64(10)))
    out = np.empty((n, 4, N_WAVES), np.float32)
    for j in range(n):
        x, y = xy[j, 0], xy[j, 1]
        for k in range(N_WAVES):
            a = turns[0, k] * x + turns[1, k] * y + turns[4, k]
            b = turns[2, k] * x + turns[3, k] * y
            out[j, 0, k] = _sine_of_turns(a + 0.25)
            out[j, 1, k] = _sine_of_turns(a)
            out[j, 2, k] = _sine_of_turns(b + 0.25)
            out[j, 3, k] = _sine_of_turns(b)
    return out


@kernel
def _field(waves, d, decorrelation_m, a, b, lanes, out):
    """Values of links (a, b) of lengths d: sums over the waves at both ends, each end once as the first."""
    for m in range(len(a)):
        one, other = waves[a[m]], waves[b[m]]
        for k in range(N_WAVES):
            lanes[k] = one[0, k] * other[2, k] - one[1, k] * other[3, k]
            lanes[k] += other[0, k] * one[2, k] - other[1, k] * one[3, k]
        for half in (16, 8, 4, 2, 1):  # a fixed order of summation, wide enough for vector units
            for k in range(half):
                lanes[k] += lanes[k + half]
        correlation = np.exp(-np.sqrt(2.0) * d[m] / decorrelation_m)
        out[m] = lanes[0] / np.sqrt(N_WAVES * (1 + correlation))


def link_field(
    xy_m: Float[ndarray, "n 2"],
    a: Int[ndarray, "m"],
    b: Int[ndarray, "m"],
    d: Float[ndarray, "m"],
    decorrelation_m: float,
    rng_key: np.uint64,
) -> Float[ndarray, "m"]:
    """Standard normal value of each link (a, b), a smooth function of the positions of its two ends.

    Parameters
    ----------
    xy_m
        Horizontal positions of the N stations [m].
    a, b, d
        Rows of the two ends of each link, and its length [m].
    decorrelation_m
        Movement of one end that reduces the correlation to 1/e [m].
    rng_key
        Key of the draws.

    Returns
    -------
    One value per link. It is the same for (a, b) and (b, a).

    Notes
    -----
    The value is a sum of 32 plane waves over (x_a, x_b), made symmetric in the two ends. It needs no state, and links
    may come in any order. If one end moves by D, the correlation is exp(-D / decorrelation). If both move by D, it is
    exp(-sqrt(2) D / decorrelation).   Deviations: with 32 waves the value is only approximately normal, and links at
    distant positions keep a correlation of about 0.1.
    """
    out = np.empty(len(a))
    xy_m, decorrelation_m = np.ascontiguousarray(xy_m, np.float64), float(decorrelation_m)
    waves = _waves(xy_m, decorrelation_m, rng_key)

    def fill(begin: int, end: int) -> None:
        here, lanes = slice(begin, end), np.empty(N_WAVES, np.float32)
        ends = a[here], b[here]
        _field(waves, d[here], decorrelation_m, *ends, lanes, out[here])

    in_ranges(fill, len(a))
    return out


def blocked_by_vehicle(
    d: Float[ndarray, "m"], normal: Float[ndarray, "m"], params: PropagationParams
) -> Bool[ndarray, "m"]:
    """Which links a vehicle blocks, of those that no building blocks.

    Parameters
    ----------
    d
        Length of each link [m].
    normal
        Standard normal value of each link, which decides.
    params
        Propagation. Vehicles block links only in the urban and highway models.
    """
    if params.blockage != "probabilistic" or params.model not in ("urban", "highway"):
        return np.zeros(len(d), bool)
    blocked_p = vehicle_blockage_p(np.maximum(d, 1.0), params.model, params.traffic)
    return scipy.special.ndtr(normal) < blocked_p
