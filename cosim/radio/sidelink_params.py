"""Parameters of the sidelink: resource selection, and the carriers of NR-V2X and LTE-V2X.

References
----------
.. [1] 3GPP TS 38.331 V16.11, SL-ResourcePool and SL-UE-SelectedConfigRP; TS 38.214 V16.10, clause 8.1.4.
.. [2] 3GPP TS 36.331 V14.16, SL-CommResourcePoolV2X; TS 36.213 V14.16, clause 14.1.1.6.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from cosim.radio.segmentation import ENVELOPE_BYTES
from cosim.radio.sidelink_phy import (
    LTE_RBS,
    LTE_SUBCHANNELS,
    NR_RBS,
    NR_SUBCHANNELS,
    Carrier,
    lte_carrier,
    nr_carrier,
)

SMALLEST_BYTES = 2 * ENVELOPE_BYTES
"""Least size of the largest transport block [bytes]: each segment of a message has an envelope."""


def _refuse(key: str, value: object, why: str) -> None:
    raise ValueError(f"{key} = {value} {why}")


def _one_of(key: str, value: object, allowed: object, unit: str = "") -> None:
    values = list(allowed)  # type: ignore[call-overload]
    if value not in values:
        _refuse(key, f"{value}{unit}", f"is none of the standard's values. Use one of {', '.join(map(str, values))}.")


@dataclass(frozen=True, kw_only=True, slots=True)
class SidelinkParams:
    """Resource selection of the sidelink, for the radio models `nr_mode2` and `lte_mode4`."""

    reservation_s: Annotated[float, Gt(0), Le(1)] | None = None
    """Reservation interval [s]. If it is not set, it is the interval between a station's last two messages of a kind,
    where the standard allows it; otherwise nothing is reserved."""
    keep_p: Annotated[float, Ge(0), Le(0.8)] = 0.8
    """Probability that a station keeps its resource when the re-selection counter ends: 0, 0.2, 0.4, 0.6 or 0.8."""
    counter: tuple[int, int] = (5, 15)
    """Least and largest initial value of the re-selection counter. Below a reservation interval of 100 ms, they are
    multiplied by 100 ms over the interval."""
    reselect_after: Annotated[int, Ge(1), Le(9)] = 1
    """Consecutive unused reservations after which a station selects a resource again."""
    rsrp_threshold_dbm: int = -110
    """Received power of a resource element from which a reserved resource is excluded [dBm], in steps of 2. It is
    raised by 3 dB until enough candidates remain."""
    share: Annotated[float, Ge(0.2), Le(0.5)] = 0.2
    """Share of the candidates of the selection window that must remain: 0.2, 0.35 or 0.5 (with LTE: 0.2)."""
    window_s: Annotated[float, Gt(0), Le(1)] = 0.1
    """Length of the selection window after generation, T2 [s]. It ends with the round at the latest."""
    n_transmissions: Annotated[int, Ge(1), Le(3)] = 1
    """Transmissions of each message, without feedback (blind HARQ repetitions included): 1 to 3 (with LTE: 2)."""
    aligned: bool = False
    """Whether a message of L subchannels begins only at multiples of L, instead of at every subchannel."""
    control_sinr_db: Annotated[float, Ge(-10), Le(20)] = 0.0
    """Least SINR at which the control part of a transmission is decoded [dB]."""
    cbr_threshold_dbm: Annotated[float, Ge(-112), Le(-22)] = -94.0
    """Received power of a subchannel from which it counts as busy [dBm]."""
    limits_occupancy: bool = True
    """Whether the channel busy ratio limits the share of the subchannels that a station uses (ETSI TS 103 574)."""

    def __post_init__(self) -> None:
        _one_of("radio.sidelink.keep_p", self.keep_p, (0, 0.2, 0.4, 0.6, 0.8))
        _one_of("radio.sidelink.share", self.share, (0.2, 0.35, 0.5))
        low, high = self.counter
        if not 1 <= low <= high <= 75:
            _refuse("radio.sidelink.counter", self.counter, "must be two whole numbers from 1 to 75 that do not fall.")
        if not -128 <= self.rsrp_threshold_dbm <= 0 or self.rsrp_threshold_dbm % 2:
            _refuse(
                "radio.sidelink.rsrp_threshold_dbm",
                f"{self.rsrp_threshold_dbm} dBm",
                "is none of the standard's values. Use an even number from -128 to 0.",
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class NrParams:
    """Carrier and pool of NR-V2X, for the radio model `nr_mode2`."""

    bandwidth_mhz: int = 10
    """Bandwidth of the carrier [MHz]: 10, 20, 30 or 40 in the bands of the sidelink."""
    scs_khz: Literal[15, 30, 60] = 15
    """Subcarrier spacing [kHz]. A slot lasts 1 ms at 15 kHz, 0.5 ms at 30 kHz, 0.25 ms at 60 kHz."""
    subchannel_rbs: int = 10
    """Size of a subchannel [resource blocks]: 10, 12, 15, 20, 25, 50, 75 or 100."""
    mcs: Annotated[int, Ge(0), Le(27)] = 7
    """Modulation and coding scheme of every message, row of table 5.1.3.1-1 of TS 38.214; 7 is QPSK with rate 0.51."""
    dmrs: int = 24
    """Resource elements of a resource block that carry reference signals: 12, 15, 18, 21 or 24."""
    control_symbols: Literal[2, 3] = 3
    """Symbols of the first control part."""
    control_rbs: int = 10
    """Resource blocks of the first control part: 10, 12, 15, 20 or 25, at most a subchannel."""
    re_evaluation: bool = True
    """Whether a station selects again if, before its first transmission, another station reserves the same resource."""

    def __post_init__(self) -> None:
        _one_of("radio.nr.bandwidth_mhz", self.bandwidth_mhz, (10, 20, 30, 40), " MHz")
        _one_of("radio.nr.subchannel_rbs", self.subchannel_rbs, NR_SUBCHANNELS)
        _one_of("radio.nr.dmrs", self.dmrs, (12, 15, 18, 21, 24))
        _one_of("radio.nr.control_rbs", self.control_rbs, (10, 12, 15, 20, 25))
        if self.control_rbs > self.subchannel_rbs:
            _refuse(
                "radio.nr.control_rbs",
                self.control_rbs,
                f"is more than a subchannel (radio.nr.subchannel_rbs = {self.subchannel_rbs}). Set it lower.",
            )

    def carrier(self) -> Carrier:
        """The carrier. Raises ValueError if no subchannel fits, or if the largest transport block is too small."""
        n_rbs = NR_RBS[self.scs_khz][self.bandwidth_mhz]
        if self.subchannel_rbs > n_rbs:
            _too_wide("radio.nr", self.subchannel_rbs, n_rbs)
        carrier = nr_carrier(
            self.bandwidth_mhz,
            self.scs_khz,
            self.subchannel_rbs,
            self.mcs,
            self.dmrs,
            self.control_symbols,
            self.control_rbs,
        )
        _check_size("radio.nr", carrier, self.mcs)
        return carrier


@dataclass(frozen=True, kw_only=True, slots=True)
class LteParams:
    """Carrier and pool of LTE-V2X with adjacent control and data, for the radio model `lte_mode4`."""

    bandwidth_mhz: int = 10
    """Bandwidth of the carrier [MHz]: 10 or 20 in the band of the sidelink."""
    subchannel_rbs: int = 10
    """Size of a subchannel [resource blocks]."""
    mcs: Annotated[int, Ge(0), Le(20)] = 7
    """Modulation and coding scheme of every message: 0 to 10 are QPSK, 11 to 20 are 16-QAM."""

    def __post_init__(self) -> None:
        _one_of("radio.lte.bandwidth_mhz", self.bandwidth_mhz, (10, 20), " MHz")
        _one_of("radio.lte.subchannel_rbs", self.subchannel_rbs, LTE_SUBCHANNELS)

    def carrier(self) -> Carrier:
        """The carrier. Raises ValueError if no subchannel fits, or if the largest transport block is too small."""
        n_rbs = LTE_RBS[self.bandwidth_mhz]
        if self.subchannel_rbs > n_rbs:
            _too_wide("radio.lte", self.subchannel_rbs, n_rbs)
        carrier = lte_carrier(self.bandwidth_mhz, self.subchannel_rbs, self.mcs)
        _check_size("radio.lte", carrier, self.mcs)
        return carrier


def _too_wide(section: str, rbs: int, n_rbs: int) -> None:
    _refuse(
        f"{section}.subchannel_rbs",
        rbs,
        f"is more than the {n_rbs} resource blocks of the carrier. Set it lower, or {section}.bandwidth_mhz higher.",
    )


def _check_size(section: str, carrier: Carrier, mcs: int) -> None:
    if carrier.largest_bytes < SMALLEST_BYTES:
        _refuse(
            f"{section}.mcs",
            mcs,
            f"leaves {max(carrier.largest_bytes, 0)} bytes in the whole pool; a message needs {SMALLEST_BYTES}. "
            f"Set {section}.mcs or {section}.bandwidth_mhz higher.",
        )


def check(model: str, sidelink: SidelinkParams, nr: NrParams, lte: LteParams, max_hops: int) -> None:
    """Refuse combinations that the standard forbids, if the radio model is one of the sidelink.

    Raises
    ------
    ValueError
        One line: what, why, and where to change it.
    """
    if model not in ("nr_mode2", "lte_mode4"):
        return
    if max_hops > 1:
        _refuse(
            "radio.relay.max_hops",
            max_hops,
            f'needs radio.model = "csma" or "unit_disk": there is no forwarding with "{model}".',
        )
    is_nr = model == "nr_mode2"
    carrier = nr.carrier() if is_nr else lte.carrier()
    slots = sidelink.window_s * 1000 * carrier.slots_per_ms
    least = 1 if is_nr else 20
    if abs(slots - round(slots)) > 1e-6 or slots < least:
        _refuse(
            "radio.sidelink.window_s",
            f"{sidelink.window_s:g} s",
            f"must be a whole number of slots of {1 / carrier.slots_per_ms:g} ms, at least {least}.",
        )
    if not is_nr and (slots > 100 or sidelink.n_transmissions > 2 or sidelink.share != 0.2):
        _refuse(
            "radio.model",
            f'"{model}"',
            "allows radio.sidelink.window_s up to 0.1, radio.sidelink.n_transmissions up to 2 and radio.sidelink.share "
            "= 0.2 only. Change them, or use nr_mode2.",
        )
    if sidelink.reservation_s is not None:
        period_ms = 1000 * sidelink.reservation_s
        allowed = allowed_ms(is_nr)
        if abs(period_ms - round(period_ms)) > 1e-6 or round(period_ms) not in allowed:
            _refuse(
                "radio.sidelink.reservation_s",
                f"{sidelink.reservation_s:g} s",
                "is no interval of the standard: use "
                + ("0.001 to 0.1 in steps of 0.001" if is_nr else "0.02, 0.05, 0.1")
                + ", or 0.2 to 1 in steps of 0.1.",
            )


def allowed_ms(is_nr: bool) -> set[int]:
    """Reservation intervals of the standard [ms]: `sl-ResourceReservePeriod` of [1]_, and those of [2]_."""
    return set(range(100, 1001, 100)) | (set(range(1, 100)) if is_nr else {20, 50})
