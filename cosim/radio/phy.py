"""PHY of IEEE 802.11p: noise, preamble detection, packet success against SINR, time on air.

References
----------
.. [1] IEEE 802.11-2016, clause 17: OFDM PHY at 10 MHz channel spacing.
.. [2] ns-3.44, table-based and NIST error-rate models: the curves fitted below.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Int
from numpy import ndarray

from cosim.base.bounds import Positive1000

BANDWIDTH_HZ = 10e6
PREAMBLE_NS = 4_000
"""Time to detect a preamble [ns]."""
HEADER_NS = 40_000
"""Training symbols and signal field ahead of the payload [ns]."""
SYMBOL_NS = 8_000
MAC_OVERHEAD_BYTES = 36
"""LLC/SNAP (8), the MAC header (24) and its checksum (4) added to a payload [bytes]."""
MAX_PAYLOAD_BYTES = 2304
"""Largest payload of one frame, by the standard [bytes]; larger messages are segmented above the MAC."""

BITS_PER_SYMBOL = {3.0: 24, 4.5: 36, 6.0: 48, 9.0: 72, 12.0: 96, 18.0: 144, 24.0: 192, 27.0: 216}
"""Data bits of one OFDM symbol, by data rate in Mb/s."""

CURVES: dict[str, dict[float, tuple[float, float]]] = {
    "table": {
        3.0: (-0.42, 0.395),
        4.5: (1.28, 0.523),
        6.0: (2.57, 0.394),
        9.0: (5.06, 0.389),
        12.0: (8.05, 0.477),
        18.0: (11.22, 0.445),
        24.0: (15.26, 0.523),
        27.0: (16.59, 0.514),
    },
    "nist": {
        3.0: (2.88, 0.289),
        4.5: (5.72, 0.301),
        6.0: (5.89, 0.289),
        9.0: (8.73, 0.301),
        12.0: (12.31, 0.323),
        18.0: (15.41, 0.320),
        24.0: (20.14, 0.331),
        27.0: (21.35, 0.340),
    },
}
"""(x0, w) in dB of packet success, by error model and data rate in Mb/s.

Notes
-----
PSR = exp(-(L / 336) exp((x0 - SINR) / w)), for a frame of L bytes, is a fit of the curves of [2]_ with two parameters.
With this form, the logarithms of the success of parts of a frame with different SINR add up.

Deviations: at most 0.1 from the table model and 0.015 from NIST, in the 1.5 dB in which the curve falls.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ReceiverParams:
    """Receiver of an IEEE 802.11p station."""

    rate_mbps: Positive1000 = 6.0
    """Data rate of every frame [Mb/s]: 3, 4.5, 6, 9, 12, 18, 24 or 27."""
    error_model: Literal["table", "nist"] = "table"
    """Packet success against SINR: measured AWGN tables, or the 3 dB more pessimistic NIST union bound."""
    p_min_dbm: Annotated[float, Ge(-120), Le(0)] = -92.0
    """Weakest preamble detected [dBm]; -92 is chip-like, -82 the standard's minimum at 6 Mb/s."""
    sinr_min_db: Annotated[float, Ge(-10), Le(40)] = 4.0
    """Least SINR at which a preamble is detected [dB]."""
    noise_figure_db: Annotated[float, Ge(0), Le(30)] = 7.0
    """Noise figure [dB]; 7 puts the noise of 10 MHz at -96.98 dBm."""
    cca_dbm: Annotated[float, Ge(-120), Le(0)] = -85.0
    """Received power from which the medium counts as busy [dBm]."""
    floor_dbm: Annotated[float, Ge(-130), Le(0)] = -104.0
    """Arrivals below this are neglected, as interference too [dBm]."""
    capture: bool = False
    """Whether a stronger late frame may take the receiver over from the frame being received."""
    capture_margin_db: Annotated[float, Ge(0), Le(60)] = 5.0
    """By how much the late frame must be stronger [dB]."""
    capture_window_s: Annotated[float, Gt(0), Le(1)] = 16e-6
    """How long after its start a reception can be taken over [s]."""

    def __post_init__(self) -> None:
        if self.rate_mbps not in BITS_PER_SYMBOL:
            known = ", ".join(f"{r:g}" for r in BITS_PER_SYMBOL)
            raise ValueError(
                f"radio.receiver.rate_mbps = {self.rate_mbps:g} Mb/s is not a rate of the 10 MHz channel. "
                f"Use one of {known}."
            )
        if self.floor_dbm >= min(self.cca_dbm, self.detectable_dbm):
            raise ValueError(
                f"radio.receiver.floor_dbm = {self.floor_dbm:g} dBm would hide frames that the receiver can sense. "
                f"Set it below {min(self.cca_dbm, self.detectable_dbm):.1f}."
            )

    @property
    def noise_dbm(self) -> float:
        """Noise power in the channel [dBm]."""
        thermal_mw = 1.380649e-23 * 290.0 * BANDWIDTH_HZ * 1e3
        return float(10 * np.log10(thermal_mw) + self.noise_figure_db)

    @property
    def detectable_dbm(self) -> float:
        """Weakest preamble detected without interference [dBm]."""
        return max(self.p_min_dbm, self.noise_dbm + self.sinr_min_db)


def airtime_ns(payload_bytes: Int[ndarray, "n"], rate_mbps: float) -> Int[ndarray, "n"]:
    """Time on air of frames with these payloads [ns], with preamble, headers and MAC overhead [1]_.

    Parameters
    ----------
    payload_bytes
        Payload without the MAC overhead, from 0 to `MAX_PAYLOAD_BYTES`.
    rate_mbps
        Key of `BITS_PER_SYMBOL`.

    Raises
    ------
    ValueError
        If a payload does not fit one frame.
    """
    payload_bytes = np.asarray(payload_bytes, np.int64)
    if np.any(payload_bytes < 0) or np.any(payload_bytes > MAX_PAYLOAD_BYTES):
        worst = int(payload_bytes[np.argmax(np.abs(payload_bytes - MAX_PAYLOAD_BYTES / 2))])
        raise ValueError(
            f"payload_bytes = {worst} does not fit one frame (0 to {MAX_PAYLOAD_BYTES}). Segment the message."
        )
    bits = 22 + 8 * (payload_bytes + MAC_OVERHEAD_BYTES)  # 16 service and 6 tail bits
    return HEADER_NS + SYMBOL_NS * -(-bits // BITS_PER_SYMBOL[rate_mbps])
