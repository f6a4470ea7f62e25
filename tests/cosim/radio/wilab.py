"""The sidelink in the settings of the WiLabV2Xsim reference runs, and their figures.

The channel is that of WiLabV2Xsim: path loss of WINNER+ B1, shadowing of 3 dB with a memory of 25 m in distance, a
threshold of the SINR in place of block error curves. Each allocation of a message is one subchannel here, because there
allocations do not overlap in part.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from cosim.addons.sidelink import records
from cosim.addons.sidelink.memory import SidelinkState, log_of, memory_of, room_of
from cosim.addons.sidelink.slots import run_slots
from cosim.base import rng
from cosim.radio.channel import Links
from cosim.radio.dtypes import NEVER, NONE, RECEIVED
from cosim.radio.link_budget import from_db
from cosim.radio.medium import MEDIA
from cosim.radio.message_round import Stations
from cosim.radio.params import RadioParams
from cosim.radio.phy import ReceiverParams
from cosim.radio.sidelink_params import LteParams, NrParams, SidelinkParams
from cosim.radio.sidelink_phy import Carrier, block_of, lte_block_sizes, nr_mcs
from tests import SHARED

WILAB = SHARED / "reference" / "wilab"
HERE = Path(__file__).parent / "wilab"
BIN_M = 10
PIECE = 100
"""Slots between two updates of positions."""


@dataclass(frozen=True)
class Setting:
    """One configuration."""

    is_nr: bool
    n_vehicles: int
    mcs: int
    length_bytes: int
    period: int = 100
    n_sent: int = 1
    sigma_db: float = 3.0


def made_positions(n: int, t_s: float) -> ndarray:
    """Positions of n vehicles on six lanes of 2 km, with constant speeds, reflected at the ends [m]."""
    i = np.arange(1, n + 1)
    lane = i % 6
    speed = (20 + 12 * np.modf(i * 0.7548776662466927)[0]) * np.where(lane < 3, 1, -1)
    x = np.abs((2000 * np.modf(i * 0.6180339887498949)[0] + speed * t_s) % 4000)
    return np.column_stack([np.round(np.where(x > 2000, 4000 - x, x), 2), 4.0 * lane])


def positions(n: int) -> ndarray:
    """Positions every 0.1 s: those of the shared trace for 80 vehicles, otherwise made ones [time, vehicle, 2]."""
    if n != 80:
        return np.array([made_positions(n, k / 10) for k in range(150)])
    path = WILAB / "trace.txt"
    if not path.exists():
        pytest.skip(f"no reference data: {path} is absent")
    rows = np.loadtxt(path)
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    return rows[: 150 * 80, 2:].reshape(150, 80, 2)


def budget(s: Setting) -> tuple[Carrier, float, float, float]:
    """The carrier, the mean power of a transmission at a loss of 0 dB [mW], the threshold [dB] and the range [m]."""
    if s.is_nr:
        n_rbs = next(k for k in range(1, 53) if _nr_bits(k, s.mcs) >= 8 * s.length_bytes)
        n_sub = -(-n_rbs // 10)
        rbs, carrier_rbs, share = 10 * n_sub, 52, n_sub / 5
        bits, rate, _, _ = nr_mcs(s.mcs)
        second = np.ceil(72 * 1.125 / (bits * rate))
        elements = (12 * 12 - 24) * n_rbs - 3 * 10 * 12 - second
        per_symbol = _nr_bits(n_rbs, s.mcs) / elements
    else:
        i_tbs, bits = (s.mcs, 2) if s.mcs <= 10 else (s.mcs - 1, 4)
        n_rbs = int(np.argmax(lte_block_sizes()[i_tbs] > 8 * s.length_bytes)) + 1
        rbs, share = _lte_subchannels(n_rbs + 2)
        carrier_rbs = 50
        per_symbol = lte_block_sizes()[i_tbs, n_rbs - 1] / (n_rbs * 8 * 12)
    gamma_db = 10 * np.log10(2 ** (12 * 14 * per_symbol / 180 / 0.4) - 1)
    n = carrier_rbs // rbs
    w = (0.0, 0.0, 0.0, 0.0) if s.is_nr else (3.0, 6.0, 3.0, 3.0)
    vector = 0.175 if s.mcs <= (9 if s.is_nr else 10) else 0.125
    carrier = Carrier(15, carrier_rbs, rbs, np.ones(n, np.int64), np.full(n, gamma_db), np.full(n, 1e-3), w, vector)
    per_mhz_dbm = 23 + 3 - 10 * np.log10(0.18 * n_rbs) + 10 * np.log10(share) + 3
    far_db = 7.56 - 34.6 * np.log10(0.5) + 2.7 * np.log10(5.9)
    noise_dbm = 10 * np.log10(1.38e-23 * 290 * 1e6) + 6 + 30
    range_m = 10 ** ((per_mhz_dbm - 10 * np.log10(share) - gamma_db - far_db - noise_dbm + 2 * s.sigma_db) / 40)
    return carrier, float(from_db(per_mhz_dbm)) * 0.18 * rbs, gamma_db, range_m


def _nr_bits(n_rbs: int, mcs: int) -> int:
    """WiLabV2Xsim counts the second control part in the modulation of the data; the standard has QPSK."""
    bits, rate, _, _ = nr_mcs(mcs)
    second = np.ceil(72 * 1.125 / (bits * rate))
    return block_of(((12 * 12 - 24) * n_rbs - 3 * 10 * 12 - second) * bits * rate, rate)


def _lte_subchannels(needed: int) -> tuple[int, float]:
    """Resource blocks of an allocation that holds this many, and its share of the carrier's subchannels."""
    found = []
    for size in (5, 6, 10, 15, 20, 25, 50):
        for count in range(1, 50 // size + 1):
            usable = size * count
            while not _is_smooth(usable - 2):
                usable -= 1
            if usable >= needed:
                found.append((usable, size, count))
    usable, size, count = min(found)
    return usable, count / (50 // size)


def _is_smooth(n: int) -> bool:
    for factor in (2, 3, 5):
        while n > 0 and n % factor == 0:
            n //= factor
    return n == 1


def loss_db(distance_m: ndarray) -> ndarray:
    """Path loss of WINNER+ B1 with antennas at 1.5 m and line of sight."""
    d = np.maximum(distance_m, 1e-3)
    near = 22.7 * np.log10(d) + 27 + 20 * np.log10(5.9)
    far = 40 * np.log10(d) + 7.56 - 34.6 * np.log10(0.5) + 2.7 * np.log10(5.9)
    return np.maximum(np.where(d <= 4 * 0.25 * 5.9e9 / 3e8, near, far), 0.0)


def simulate(s: Setting, seed: int, raw_m: tuple[float, ...]) -> tuple[ndarray, ndarray, list[ndarray]]:
    """One run of 15 s.

    Returns
    -------
    Received and all packets in bins of 10 m, and the times between two receptions from the same vehicle within each
    of the ranges `raw_m` [s].
    """
    carrier, power_mw, gamma_db, range_m = budget(s)
    xy_m = positions(s.n_vehicles)
    g, n = np.random.default_rng(seed), s.n_vehicles
    stations = Stations(rng.keys(np.uint64(seed), np.arange(n)), np.column_stack([xy_m[0], np.full(n, 1.5)]), n)
    params = RadioParams(
        model="nr_mode2" if s.is_nr else "lte_mode4",
        receiver=ReceiverParams(noise_figure_db=6.0),
        sidelink=SidelinkParams(reservation_s=s.period / 1000, n_transmissions=s.n_sent, limits_occupancy=False),
        nr=NrParams(re_evaluation=False),
        lte=LteParams(),
    )
    medium = MEDIA[params.model](params, 0.1, seed, None)
    rules = replace_rules(medium.rules, carrier, s)
    receiver = np.array([[j for j in range(n) if j != i] for i in range(n)]).ravel()
    links = Links(
        stations.key, (n - 1) * np.arange(n + 1), receiver, np.ones(len(receiver)), np.zeros(len(receiver), np.uint8)
    )
    air = replace_leak(medium.air(links, stations), carrier)

    n_pieces = len(xy_m)
    n_slots = n_pieces * PIECE
    first = g.uniform(0, s.period, n)
    unit = np.zeros(0, records.UNIT)
    for k in range(n_slots // s.period + 1):
        at = np.floor(first + k * s.period).astype(np.int64)
        more = np.zeros(n, records.UNIT)
        more["key"], more["generated"] = rng.keys(np.uint64(k), stations.key), at
        more["station"], more["process"], more["width"] = np.arange(n), np.arange(n), 1
        unit = np.concatenate([unit, more[at < n_slots - 101]])
    unit = unit[np.lexsort((unit["generated"], unit["station"]))]
    unit["deadline"], unit["n_sent"], unit["slot"] = n_slots - 1, s.n_sent, NEVER
    unit["sinr_db"], unit["spread_db"], unit["clear_sinr"], unit["dead_sinr"] = gamma_db, 1e-3, *2 * [from_db(gamma_db)]
    process = np.zeros(n, records.PROCESS)
    process["key"], process["station"] = rng.keys(np.uint64(7), stations.key), stations.key
    process["generated"] = NONE
    reserve_at_random(process, np.floor(first).astype(np.int64), s, carrier.n_subchannels, g)
    station = np.zeros(n, records.STATION)
    station["key"] = stations.key
    memory = memory_of(process, station, np.full(n, NONE), SidelinkState(), unit, links, rules, 0)
    log = log_of(unit, links, n_slots)
    room = room_of(rules)
    arrival = np.lexsort((unit["key"], unit["generated"]))

    shadow = np.zeros((n, n))
    upper = np.triu_indices(n, 1)
    values = g.normal(0, s.sigma_db, len(upper[0])) if s.sigma_db else np.zeros(len(upper[0]))
    apart = np.linalg.norm(xy_m[:, :, None] - xy_m[:, None], axis=3)
    off = ~np.eye(n, dtype=bool)
    for piece in range(n_pieces):
        if piece and s.sigma_db:
            moved = np.abs(apart[piece] - apart[piece - 1])[upper]
            memory_of_it = np.exp(-moved / 25)
            values = memory_of_it * values + np.sqrt(1 - memory_of_it**2) * g.normal(0, s.sigma_db, len(values))
        shadow[upper] = values
        db = np.maximum(loss_db(apart[piece]) - shadow - shadow.T, 0.0)
        air.mean_mw[:] = (power_mw * from_db(-db))[off]
        due = (unit["generated"][arrival] >= piece * PIECE) & (unit["generated"][arrival] < (piece + 1) * PIECE)
        run_slots(0, piece * PIECE, (piece + 1) * PIECE, arrival[due], air, memory, log, room, rules)
    return figures(unit, log, apart, range_m, raw_m, n)


def reserve_at_random(process, first, s: Setting, n_subchannels: int, g) -> None:
    """Reserve a random resource for each vehicle, as WiLabV2Xsim does at its start, before anything is sensed.

    The counter is drawn at the start too. It falls when the resource passes, also if the first message comes after it.
    """
    n = len(process)
    resource = g.integers(0, s.period, n)
    process["next_slot"] = first + 1 + (resource - first - 1) % s.period
    process["period"], process["width"], process["n_sent"] = s.period, 1, s.n_sent
    process["counter"] = g.integers(5, 16, n) - (resource <= first)
    process["sub"][:, : s.n_sent] = g.integers(0, n_subchannels, (n, s.n_sent))
    if s.n_sent == 2:
        other = (resource + g.integers(1, s.period, n)) % s.period
        slot = np.sort(np.column_stack([process["next_slot"], first + 1 + (other - first - 1) % s.period]), axis=1)
        process["next_slot"], process["gap"][:, 1] = slot[:, 0], slot[:, 1] - slot[:, 0]


def figures(unit, log, apart, range_m, raw_m, n):
    """Received and all packets by distance, and times between receptions."""
    sent = unit["n_sent"] > 0
    rows = np.flatnonzero(sent)
    degree = n - 1
    got = np.zeros((len(unit), degree), bool)
    block = log.reception.reshape(len(unit), records.MAX_SENT, degree)
    last = unit["slot"][np.arange(len(unit)), np.maximum(unit["n_sent"] - 1, 0)]
    when = np.full((len(unit), degree), -1, np.int64)
    for a in range(records.MAX_SENT):
        ok = (block[:, a] == RECEIVED) & (unit["n_sent"] > a)[:, None] & ~got
        got |= ok
        when[ok] = np.broadcast_to(unit["slot"][:, a : a + 1], ok.shape)[ok]
    j = np.arange(degree)[None] + (np.arange(degree)[None] >= unit["station"][:, None])
    piece = np.minimum(last // PIECE, len(apart) - 1)
    d = apart[piece[:, None], unit["station"][:, None], j]
    n_bins = int(range_m // BIN_M)
    keep = sent[:, None] & (d < range_m)
    bins = np.minimum((d / BIN_M).astype(int), n_bins)
    total = np.bincount(bins[keep], minlength=n_bins + 1)[:n_bins]
    good = np.bincount(bins[keep & got], minlength=n_bins + 1)[:n_bins]
    gaps = []
    for raw in raw_m:
        found = []
        for i in range(n):
            of = rows[unit["station"][rows] == i]
            for k in range(degree):
                since = -1
                for u in of:
                    if d[u, k] >= raw:
                        since = -1
                    elif got[u, k]:
                        if since >= 0:
                            found.append(when[u, k] - since)
                        since = when[u, k]
        gaps.append(np.array(found) / 1000)
    return good, total, gaps


def replace_rules(rules, carrier: Carrier, s: Setting):
    return rules._replace(n_subchannels=carrier.n_subchannels, rbs=carrier.rbs, lead=0)


def replace_leak(air, carrier: Carrier):
    return air._replace(leak=carrier.leak(), density_mw=np.zeros((len(air.key), carrier.n_subchannels)))
