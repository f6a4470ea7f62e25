"""PHY of the sidelink: transport blocks, subchannels of a message, block errors, and in-band emission.

References
----------
.. [1] 3GPP TS 38.214 V16.10, clauses 5.1.3 (MCS table 1, transport block size) and 8.1.3.2 (sidelink).
.. [2] 3GPP TS 36.213 V14.16, clauses 7.1.7.2.1 and 14.1.1: transport block size of LTE, tables 7.1.7.2.1-1 and 8.6.1-1.
.. [3] 3GPP TS 38.101-1 V17.0, clause 6.4F.2.3; TS 36.101 V15.0, clause 6.5.2G.3: in-band emission.
.. [4] S. Lagen, K. Wanuga, H. Elkotby, S. Goyal, N. Patriciello, L. Giupponi, "New radio physical layer abstraction for
   system-level simulations of 5G networks", ICC 2020; its tables are those of 5G-LENA (`nr-eesm-t1`).
.. [5] M. Mezzavilla, M. Miozzo, M. Rossi, N. Baldo, M. Zorzi, "A lightweight and accurate link abstraction model for
   the simulation of LTE networks in ns-3", MSWiM 2012; its tables are those of ns-3 (`lte-mi-error-model.cc`, commit
   1406466), from link simulations with the Vienna LTE simulator.
.. [6] 3GPP TR 36.885 V14.0, annex A.2.1.1: in-band emission of LTE-V2X.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

MAC_OVERHEAD_BYTES = 16
"""Headers of PDCP, RLC and MAC (SDU type, sequence number, source and destination) added to a message [bytes]."""
CRC_BITS = 24

NR_MCS: tuple[tuple[int, int], ...] = (
    (2, 120), (2, 157), (2, 193), (2, 251), (2, 308), (2, 379), (2, 449), (2, 526), (2, 602), (2, 679),
    (4, 340), (4, 378), (4, 434), (4, 490), (4, 553), (4, 616), (4, 658),
    (6, 438), (6, 466), (6, 517), (6, 567), (6, 616), (6, 666), (6, 719), (6, 772), (6, 822), (6, 873), (6, 910),
)  # fmt: skip
"""Bits per symbol and 1024 times the code rate of MCS 0 to 27: table 5.1.3.1-1 of [1]_."""

NR_CURVES: tuple[tuple[float, float], ...] = (
    (-1.29, 0.19), (-0.72, 0.18), (0.02, 0.18), (1.14, 0.18), (1.76, 0.19), (2.53, 0.21), (3.20, 0.20), (3.96, 0.19),
    (4.64, 0.20), (5.40, 0.21), (6.10, 0.20), (6.67, 0.20), (7.53, 0.21), (8.42, 0.22), (9.28, 0.23), (10.12, 0.22),
    (10.61, 0.22), (11.35, 0.23), (11.81, 0.22), (12.83, 0.23), (13.84, 0.25), (14.81, 0.24), (15.64, 0.24),
    (16.63, 0.19), (17.67, 0.20), (18.54, 0.19), (19.63, 0.21), (20.36, 0.22),
)  # fmt: skip
"""Mean and standard deviation [dB] of the normal distribution that is the success against SINR, for MCS 0 to 27.

Notes
-----
Fits of the block errors in AWGN of table 1 of [4]_, for code blocks of 2,024 bits (base graph 2, up to MCS 22) and
5,504 bits (base graph 1).   Deviations: at most 0.03 in the block error ratio at the table's points; blocks of 1,000 to
8,000 bits differ by up to 0.25 dB; code blocks of one transport block fail together.
"""

NR_TBS = np.array([
    24, 32, 40, 48, 56, 64, 72, 80, 88, 96, 104, 112, 120, 128, 136, 144, 152, 160, 168, 176, 184, 192, 208, 224, 240,
    256, 272, 288, 304, 320, 336, 352, 368, 384, 408, 432, 456, 480, 504, 528, 552, 576, 608, 640, 672, 704, 736, 768,
    808, 848, 888, 928, 984, 1032, 1064, 1128, 1160, 1192, 1224, 1256, 1288, 1320, 1352, 1416, 1480, 1544, 1608, 1672,
    1736, 1800, 1864, 1928, 2024, 2088, 2152, 2216, 2280, 2408, 2472, 2536, 2600, 2664, 2728, 2792, 2856, 2976, 3104,
    3240, 3368, 3496, 3624, 3752, 3824,
])  # fmt: skip
"""Transport block sizes up to 3,824 bits: table 5.1.3.2-1 of [1]_."""

NR_RBS: dict[int, dict[int, int]] = {
    15: {5: 25, 10: 52, 15: 79, 20: 106, 25: 133, 30: 160, 40: 216, 50: 270},
    30: {5: 11, 10: 24, 15: 38, 20: 51, 25: 65, 30: 78, 40: 106, 50: 133, 60: 162, 80: 217, 100: 273},
    60: {10: 11, 15: 18, 20: 24, 25: 31, 30: 38, 40: 51, 50: 65, 60: 79, 80: 107, 100: 135},
}
"""Resource blocks by subcarrier spacing [kHz] and bandwidth [MHz]: table 5.3.2-1 of TS 38.101-1."""
NR_SUBCHANNELS = (10, 12, 15, 20, 25, 50, 75, 100)
"""Sizes of a subchannel [resource blocks], `sl-SubchannelSize`."""
LTE_RBS = {5: 25, 10: 50, 15: 75, 20: 100}
LTE_SUBCHANNELS = (5, 6, 8, 9, 10, 12, 15, 16, 18, 20, 25, 30, 48, 50, 72, 75, 96, 100)
"""Sizes of a subchannel [resource blocks], `sizeSubchannel` of TS 36.331."""

LTE_CURVES: dict[int, tuple[tuple[float, float, float], ...]] = {
    2: (
        (0.08, -7.38, 0.16), (0.10, -6.42, 0.15), (0.11, -6.00, 0.15), (0.15, -4.65, 0.15), (0.19, -3.57, 0.16),
        (0.24, -2.56, 0.16), (0.30, -1.61, 0.16), (0.37, -0.55, 0.16), (0.44, 0.45, 0.16), (0.51, 1.35, 0.16),
        (0.60, 2.50, 0.16), (0.70, 3.76, 0.16), (0.80, 5.11, 0.16), (0.90, 6.78, 0.16),
    ),
    4: (
        (0.30, 3.23, 0.16), (0.33, 3.63, 0.17), (0.37, 4.39, 0.17), (0.42, 5.28, 0.18), (0.48, 6.26, 0.19),
        (0.54, 7.21, 0.19), (0.60, 8.17, 0.20), (0.70, 9.77, 0.20), (0.80, 11.44, 0.20), (0.90, 13.40, 0.20),
    ),
}  # fmt: skip
"""Code rate, mean and standard deviation [dB] of the success against SINR, for QPSK (2) and 16-QAM (4).

Notes
-----
From the tables `bEcrTable` and `cEcrTable` of [5]_ for code blocks of 2,560 bits: the block error ratio in AWGN is a
normal distribution of the mutual information per bit, which its tables `MI_map` convert to SINR.   Deviations: blocks
of 1,024 to 6,144 bits differ by up to 0.13 dB. The source ends at a code rate of 0.51 (QPSK) and 0.60 (16-QAM), and the
sidelink has fewer symbols for data than the downlink. Rows above keep the last row's distance to the mutual information
of the modulation, in dB.
"""


@dataclass(frozen=True, slots=True)
class Carrier:
    """A carrier with its resource pool, and the sizes of transport blocks on 1 to S subchannels."""

    scs_khz: int
    n_rbs: int
    """Of the carrier."""
    rbs: int
    """Of a subchannel."""
    block_bits: Int[ndarray, "s"]
    """Largest transport block on 1 to S subchannels; 0 where the standard has none."""
    sinr_db: Float[ndarray, "s"]
    """Mean of the block error curve on 1 to S subchannels."""
    spread_db: Float[ndarray, "s"]
    """Its standard deviation."""
    emission: tuple[float, float, float, float]
    """Offsets W, X, Y, Z of the in-band emission [dB] [6]_."""
    error_vector: float
    """Error vector magnitude."""

    @property
    def n_subchannels(self) -> int:
        """Number of subchannels S of the pool."""
        return len(self.block_bits)

    @property
    def slots_per_ms(self) -> int:
        """Slots in one millisecond."""
        return self.scs_khz // 15

    @property
    def largest_bytes(self) -> int:
        """Longest message of one transport block [bytes]."""
        return int(self.block_bits.max()) // 8 - MAC_OVERHEAD_BYTES

    def width(self, length_bytes: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """Number of subchannels of messages of these lengths, each at most `largest_bytes`.

        Parameters
        ----------
        length_bytes
            Length of each message, without the headers of layer 2.
        """
        bits = 8 * (np.asarray(length_bytes) + MAC_OVERHEAD_BYTES)
        fits = self.block_bits[None, :] >= bits[:, None]
        assert fits.any(axis=1).all()
        return 1 + fits.argmax(axis=1)

    def leak(self) -> Float[ndarray, "w s c"]:
        """Power per resource block of each subchannel, for transmissions of 1 W.

        Returns
        -------
        By width (0 to S), first subchannel and receiving subchannel. On its own subchannels a transmission has the same
        power on all resource blocks. On the others it has the in-band emission of [3]_.

        Notes
        -----
        General part: the largest of -25 - 10 log(N/L) - X, 20 log EVM - 3 - 5 (d - 1)/L - W, and a floor; plus the
        image -25 - Y and the carrier leakage -25 - Z, on the resource blocks that they hit. N are the carrier's
        resource blocks, L those of the transmission, d the distance to its edge.   Deviations: mean over the resource
        blocks of a subchannel; relative to the power per resource block; the carrier leakage, which is an absolute
        requirement, has the power of the transmission as reference.
        """
        s_n, w_db, x_db, y_db, z_db = self.n_subchannels, *self.emission
        rb = np.arange(s_n * self.rbs)
        centre, is_even = self.n_rbs // 2, self.n_rbs % 2 == 0
        middle = (rb == centre) | (is_even & (rb == centre - 1))
        image_power = 10 ** (-(25 + y_db) / 10)
        carrier_power = 10 ** (-(25 + z_db) / 10)
        out = np.zeros((s_n + 1, s_n, s_n))
        for width in range(1, s_n + 1):
            length = width * self.rbs
            for first in range(s_n - width + 1):
                begin, end = first * self.rbs, first * self.rbs + length
                away = np.maximum(begin - rb, rb - end + 1)
                floor_db = -25 - 10 * np.log10(self.n_rbs / length) - x_db
                slope_db = 20 * np.log10(self.error_vector) - 3 - 5 * (away - 1) / length - w_db
                general = 10 ** (np.maximum(floor_db, slope_db) / 10)
                mirrored = self.n_rbs - 1 - rb
                image = (mirrored >= begin) & (mirrored < end)
                leaked = general + image * image_power + middle * carrier_power
                power = np.where(away <= 0, 1.0, leaked) / length
                out[width, first] = power.reshape(s_n, self.rbs).mean(axis=1)
                out[width, first, first : first + width] = 1.0 / length
        return out


def nr_block_bits(n_rbs: int, mcs: int, *, dmrs: int, control_symbols: int, control_rbs: int) -> int:
    """Transport block size of a sidelink transmission on this many resource blocks [bits] [1]_.

    Parameters
    ----------
    n_rbs
        Resource blocks of the allocation.
    mcs
        Row of `NR_MCS`.
    dmrs
        Resource elements of a resource block that carry reference signals.
    control_symbols, control_rbs
        Size of the first control part (PSCCH).

    Notes
    -----
    Twelve of the slot's 14 symbols carry the shared channel; there is no feedback channel. The second control part has
    48 bits and its CRC 24, in QPSK with the code rate of the data and an offset of 1.125.   Deviations: none.
    """
    bits, rate = NR_MCS[mcs][0], NR_MCS[mcs][1] / 1024
    elements = (12 * 12 - dmrs) * n_rbs
    of_control = control_symbols * control_rbs * 12
    needed = int(np.ceil((48 + 24) * 1.125 / (2 * rate)))
    most = int(np.ceil(0.5 * (12 * 12 * n_rbs - of_control)))
    second = min(needed, most)
    return block_of((elements - of_control - second) * bits * rate, rate)


def block_of(information: float, rate: float) -> int:
    """Transport block size for this many information bits and code rate [bits]: TS 38.214 5.1.3.2 [1]_."""
    if information < 24:
        return 0
    if information <= 3824:
        step = 2 ** max(3, int(np.floor(np.log2(information))) - 6)
        least = max(24, step * int(information // step))
        return int(NR_TBS[np.searchsorted(NR_TBS, least)])
    step = 2 ** (int(np.floor(np.log2(information - 24))) - 5)
    rounded = max(3840, step * int((information - 24) / step + 0.5))  # ties upwards
    if rate <= 0.25:
        n = int(np.ceil((rounded + 24) / 3816))
    else:
        n = int(np.ceil((rounded + 24) / 8424)) if rounded >= 8424 else 1
    return 8 * n * int(np.ceil((rounded + 24) / (8 * n))) - 24


@cache
def nr_carrier(
    bandwidth_mhz: int, scs_khz: int, rbs: int, mcs: int, dmrs: int, control_symbols: int, control_rbs: int
) -> Carrier:
    """The carrier of NR-V2X with these parameters. Its pool has all whole subchannels that fit."""
    n_rbs = NR_RBS[scs_khz][bandwidth_mhz]
    sizes = [
        nr_block_bits(k * rbs, mcs, dmrs=dmrs, control_symbols=control_symbols, control_rbs=control_rbs)
        for k in range(1, n_rbs // rbs + 1)
    ]
    blocks = np.array(sizes, np.int64)
    mean_db, spread_db = NR_CURVES[mcs]
    error_vector = {2: 0.175, 4: 0.125, 6: 0.08}[NR_MCS[mcs][0]]
    sinr_db, sinr_spread_db = (np.full(len(blocks), value) for value in (mean_db, spread_db))
    return Carrier(scs_khz, n_rbs, rbs, blocks, sinr_db, sinr_spread_db, (0.0, 0.0, 0.0, 0.0), error_vector)


@cache
def lte_block_sizes() -> Int[ndarray, "tbs rb"]:
    """Transport block sizes [bits] by I_TBS (0 to 19) and resource blocks less one (0 to 99): table of [2]_."""
    path = Path(__file__).parent / "tables" / "ts36213_tbs.csv"
    return np.loadtxt(path, dtype=np.int64, delimiter=",")


def lte_data_rbs(n_rbs: int) -> int:
    """The largest number of resource blocks up to this one that has no prime factors but 2, 3 and 5 [2]_."""
    for n in range(n_rbs, 0, -1):
        rest = n
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return n
    return 0


@cache
def lte_carrier(bandwidth_mhz: int, rbs: int, mcs: int) -> Carrier:
    """The carrier of LTE-V2X with control and data in adjacent resource blocks. Two of them carry control.

    Notes
    -----
    MCS 0 to 10 are QPSK, 11 to 20 are 16-QAM; I_TBS is that of table 8.6.1-1 of [2]_. Nine of the subframe's 14 symbols
    carry data: four have reference signals, and the last one is a guard. `LTE_CURVES` is interpolated at the code rate.
    Deviations: the curve does not depend on the length; below the least code rate it stays.
    """
    n_rbs = LTE_RBS[bandwidth_mhz]
    data = np.array([lte_data_rbs(k * rbs - 2) for k in range(1, n_rbs // rbs + 1)])
    i_tbs, bits = (mcs, 2) if mcs <= 10 else (mcs - 1, 4)
    sizes = lte_block_sizes()[i_tbs, np.maximum(data, 1) - 1]
    blocks = np.where(data > 0, sizes, 0)
    efficiency = (blocks + CRC_BITS) / np.maximum(data * 9 * 12, 1)
    blocks = np.where(efficiency <= 0.93 * bits, blocks, 0)
    rate, mean_db, spread_db = np.array(LTE_CURVES[bits]).T
    error_vector = 0.175 if bits == 2 else 0.125
    sinr_db, sinr_spread_db = (np.interp(efficiency / bits, rate, column) for column in (mean_db, spread_db))
    return Carrier(15, n_rbs, rbs, blocks, sinr_db, sinr_spread_db, (3.0, 6.0, 3.0, 3.0), error_vector)
