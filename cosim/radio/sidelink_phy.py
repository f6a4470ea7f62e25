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
                error_db = 20 * np.log10(self.error_vector)
                slope_db = error_db - 3 - 5 * (away - 1) / length - w_db
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
        As in `nr_mcs`.
    dmrs
        Resource elements of a resource block that carry reference signals.
    control_symbols, control_rbs
        Size of the first control part (PSCCH).

    Notes
    -----
    Twelve of the slot's 14 symbols carry the shared channel; there is no feedback channel. The second control part has
    48 bits and its CRC 24, in QPSK with the code rate of the data and an offset of 1.125.   Deviations: none.
    """
    bits, rate, _, _ = nr_mcs(mcs)
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
        sizes = nr_small_blocks()
        return int(sizes[np.searchsorted(sizes, least)])
    step = 2 ** (int(np.floor(np.log2(information - 24))) - 5)
    rounded = max(3840, step * int((information - 24) / step + 0.5))  # ties upwards
    if rate <= 0.25:
        n = int(np.ceil((rounded + 24) / 3816))
    else:
        n = int(np.ceil((rounded + 24) / 8424)) if rounded >= 8424 else 1
    unit_bits = 8 * n
    return unit_bits * int(np.ceil((rounded + 24) / unit_bits)) - 24


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
    bits, _, mean_db, spread_db = nr_mcs(mcs)
    return Carrier(
        scs_khz=scs_khz,
        n_rbs=n_rbs,
        rbs=rbs,
        block_bits=blocks,
        sinr_db=np.full(len(blocks), mean_db),
        spread_db=np.full(len(blocks), spread_db),
        emission=(0.0, 0.0, 0.0, 0.0),
        error_vector={2: 0.175, 4: 0.125, 6: 0.08}[bits],
    )


@cache
def _table(name: str) -> Float[ndarray, "rows columns"]:
    """A table of this package. Its first line says what the columns are."""
    return np.loadtxt(Path(__file__).parent / "tables" / name, delimiter=",", ndmin=2)


def nr_mcs(mcs: int) -> tuple[int, float, float, float]:
    """Bits per symbol, code rate, and mean and standard deviation of the block error curve [dB] of an MCS of NR.

    Parameters
    ----------
    mcs
        From 0 to 27.

    Notes
    -----
    Bits and rate are those of table 5.1.3.1-1 of [1]_. The success against SINR is a normal distribution, fitted to the
    block errors in AWGN of table 1 of [4]_, for code blocks of 2,024 bits (base graph 2, up to MCS 22) and 5,504 bits
    (base graph 1).   Deviations: at most 0.03 in the block error ratio at the table's points; blocks of 1,000 to 8,000
    bits differ by up to 0.25 dB; code blocks of one transport block fail together.
    """
    bits, rate_1024, mean_db, spread_db = _table("nr_mcs.csv")[mcs].tolist()
    return int(bits), rate_1024 / 1024, mean_db, spread_db


@cache
def nr_small_blocks() -> Int[ndarray, "k"]:
    """Transport block sizes of NR up to 3,824 bits, ascending: table 5.1.3.2-1 of [1]_."""
    return _table("nr_tbs.csv")[:, 0].astype(np.int64)


def lte_curve(bits: int) -> Float[ndarray, "k 3"]:
    """Code rate, mean and standard deviation [dB] of the success against SINR, for QPSK (2 bits) and 16-QAM (4).

    Notes
    -----
    From the tables `bEcrTable` and `cEcrTable` of [5]_ for code blocks of 2,560 bits: the block error ratio in AWGN is
    a normal distribution of the mutual information per bit, which its tables `MI_map` convert to SINR.   Deviations:
    blocks of 1,024 to 6,144 bits differ by up to 0.13 dB. The source ends at a code rate of 0.51 (QPSK) and 0.60
    (16-QAM), and the sidelink has fewer symbols for data than the downlink. Rows above keep the last row's distance to
    the mutual information of the modulation, in dB.
    """
    table = _table("lte_curves.csv")
    return table[table[:, 0] == bits, 1:]


@cache
def lte_block_sizes() -> Int[ndarray, "tbs rb"]:
    """Transport block sizes [bits] by I_TBS (0 to 19) and resource blocks less one (0 to 99): table of [2]_."""
    return _table("ts36213_tbs.csv").astype(np.int64)


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
    carry data: four have reference signals, and the last one is a guard. `lte_curve` is interpolated at the code rate.
    Deviations: the curve does not depend on the length; below the least code rate it stays.
    """
    n_rbs = LTE_RBS[bandwidth_mhz]
    n_subchannels = n_rbs // rbs
    data = np.array([lte_data_rbs(k * rbs - 2) for k in range(1, n_subchannels + 1)])
    i_tbs, bits = (mcs, 2) if mcs <= 10 else (mcs - 1, 4)
    sizes = lte_block_sizes()[i_tbs, np.maximum(data, 1) - 1]
    blocks = np.where(data > 0, sizes, 0)
    efficiency = (blocks + CRC_BITS) / np.maximum(data * 9 * 12, 1)
    blocks = np.where(efficiency <= 0.93 * bits, blocks, 0)
    rate, mean_db, spread_db = lte_curve(bits).T
    return Carrier(
        scs_khz=15,
        n_rbs=n_rbs,
        rbs=rbs,
        block_bits=blocks,
        sinr_db=np.interp(efficiency / bits, rate, mean_db),
        spread_db=np.interp(efficiency / bits, rate, spread_db),
        emission=(3.0, 6.0, 3.0, 3.0),
        error_vector=0.175 if bits == 2 else 0.125,
    )
