"""Propagation, reception, and lines of sight."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.compare.facts import Measured
from cosim.radio.bodies import Bodies, tallest_blocker_m
from cosim.radio.channel import AccessParams, ChannelRules, ChannelState, Links, Packets, PhyOutcome, run_window
from cosim.radio.phy import ReceiverParams, airtime_ns
from cosim.radio.propagation import blockage_mean_db, fading_class, log_distance_db, tr37885_db
from cosim.runs.replay_lidar import city_of, config_of, worlds
from cosim.traffic.streetside import PARKED
from results.run import Run
from sensors.line_of_sight import WallIndex, los_between_actors
from sensors.scene import Shape

_PERIOD_NS = 10_000_000
_N_PACKETS = 4000
_DCF = AccessParams(aifsn=(2, 2, 2, 2), cw=(15, 15, 15, 15))


def frame_airtime(runs: Sequence[Run], *, payload_bytes: Sequence[int], rate_mbps: float) -> Measured:
    """Time on air of a frame [us]."""
    return Measured.exact(airtime_ns(np.array(payload_bytes), rate_mbps) / 1000)


def path_loss(runs: Sequence[Run], *, scenario: str, nlos: bool, distance_m: Sequence[float]) -> Measured:
    """Path loss of TR 37.885 without shadowing and blockage [dB]."""
    d = np.array(distance_m, float)
    return Measured.exact(tr37885_db(d, np.full(len(d), nlos), "urban" if scenario == "urban" else "highway"))


def blockage(runs: Sequence[Run], *, heights_m: Sequence[Sequence[float]], distance_m: float) -> Measured:
    """Mean loss behind a vehicle of 1.6 m by the heights of the two antennas [dB]."""
    a, b = np.array(heights_m, float).T
    return Measured.exact(blockage_mean_db(np.full(len(a), distance_m), a, b)[0])


def delivery_of_one_sender(runs: Sequence[Run], *, distance_m: Sequence[float], p_min_dbm: float) -> Measured:
    """Packet delivery ratio by distance, of one sender with Nakagami fading and the loss of distance to 2.75.

    Each value is the mean over five receivers 5 m apart around the distance.
    """
    away = np.array(distance_m, float)[:, None] + 5.0 * np.arange(-2, 3)
    loss_db = log_distance_db(away.ravel(), 2.75)
    received = _received(loss_db, away.ravel(), 300, ReceiverParams(p_min_dbm=p_min_dbm), 23.0)
    return _of_shares(received.reshape(len(away), -1))


def reception_around_corner(
    runs: Sequence[Run],
    *,
    sender_m: Sequence[float],
    receiver_m: float,
    power_dbm: float,
    loss_db: float,
    payload_bytes: int,
    rate_mbps: float,
    corners: int = 400,
) -> Measured:
    """Share of frames that a vehicle receives from another one in a side street, both without line of sight.

    Parameters
    ----------
    sender_m, receiver_m
        Distances to the centre of the junction.
    power_dbm, loss_db
        Transmitted power, and losses in the cables of both ends.
    corners
        Junctions over which shadowing is averaged.
    """
    away = np.hypot(np.array(sender_m, float), receiver_m)
    receiver = ReceiverParams(rate_mbps=rate_mbps)
    return _of_shares(_behind_corners(away, corners, payload_bytes, receiver, power_dbm, loss_db))


def range_around_corner(
    runs: Sequence[Run], *, sender_m: Sequence[float], least: float, payload_bytes: int, corners: int = 100
) -> Measured:
    """Distance to the centre of a junction up to which a vehicle in a side street receives the least share [m].

    Parameters
    ----------
    sender_m
        Distance of the sender to the centre.
    least
        Share of frames that must be received, with the default power and receiver.
    corners
        Junctions of one of the four replicates.
    """
    receiver_m, rows = np.arange(10.0, 151.0, 5.0), []
    for sender in sender_m:
        away = np.hypot(sender, receiver_m)
        share = _behind_corners(away, 4 * corners, payload_bytes, ReceiverParams(), 23.0, 0.0)
        mean = share.reshape(len(away), 4, corners).mean(axis=2)
        below = np.argmax(mean < least, axis=0)  # the first distance that is too far
        near, far = mean[below - 1, np.arange(4)], mean[below, np.arange(4)]
        rows.append(receiver_m[below] - 5.0 * (least - far) / (near - far))
    return Measured.of_replicates(list(np.array(rows).T))


def _behind_corners(
    away_m: Float[ndarray, "k"], corners: int, payload_bytes: int, receiver: ReceiverParams, power_dbm: float,
    loss_db: float,
) -> Float[ndarray, "k c"]:  # fmt: skip
    """Share of frames received without line of sight at each distance, behind each of many corners."""
    draws = np.random.default_rng(1).normal(size=(len(away_m), corners))
    loss = (tr37885_db(away_m, np.ones(len(away_m), bool), "urban") + loss_db)[:, None] + 4.0 * draws  # dB, TR 37.885
    received = _received(loss.ravel(), np.repeat(away_m, corners), payload_bytes, receiver, power_dbm, 200)
    return received.reshape(len(away_m), corners)


def _received(
    loss_db: Float[ndarray, "r"],
    away_m: Float[ndarray, "r"],
    payload_bytes: int,
    receiver: ReceiverParams,
    power_dbm: float,
    n_packets: int = _N_PACKETS,
) -> Float[ndarray, "r"]:
    """Share of the packets of one sender that each of many silent stations receives."""
    power = (10 ** ((power_dbm - loss_db) / 10)).astype(np.float32)
    n, packets, ones = len(power), np.arange(n_packets), np.ones(n_packets, np.int64)
    ptr = np.concatenate([[0], np.full(n + 1, n)])
    names, fading = np.arange(1, n + 2, dtype=np.uint64), fading_class(away_m, "nakagami")
    links = Links(names, ptr, np.arange(1, n + 1), power, fading)
    sent = Packets(
        0 * ones, packets.astype(np.uint64), packets * _PERIOD_NS, payload_bytes * ones,
        np.full(n_packets, 2, np.uint8), 10 * _PERIOD_NS * ones, packets,
    )  # fmt: skip
    rules = ChannelRules(np.uint64(1), receiver, _DCF)
    _, out = run_window(ChannelState.start(), links, sent, n_packets * _PERIOD_NS, rules)
    return np.bincount(out.receiver[out.reception == PhyOutcome.RECEIVED], minlength=n + 1)[1:] / n_packets


def _of_shares(share: Float[ndarray, "k r"]) -> Measured:
    """Mean over receivers, with an interval from their spread."""
    mean = share.mean(axis=1)
    half = 1.96 * share.std(axis=1, ddof=1) / np.sqrt(share.shape[1])
    return Measured(mean, np.maximum(mean - half, 0), np.minimum(mean + half, 1), share.shape[1])


def sight_past_buildings(runs: Sequence[Run], *, distance_m: Sequence[float]) -> Measured:
    """Share of the pairs of vehicles at some distances that no building hides from each other."""
    rows = []
    for run in runs:
        table = run.pdr_by_distance
        table = table[table.los_state.isin(["los", "nlos"])]
        by = table.groupby(["distance_bin_m", "los_state"], observed=True).n_in_range.sum().unstack(fill_value=0)
        share = by.get("los", 0) / by.sum(axis=1)
        middle = share.index.to_numpy(float) + np.diff(share.index.to_numpy(float)).min() / 2
        rows.append(np.interp(distance_m, middle, share.to_numpy(float)))
    return Measured.of_replicates(rows)


def sight_past_everything(
    runs: Sequence[Run], *, distance_m: Sequence[float], trees: bool = True, bodies: bool = True, every_s: float = 20.0
) -> Measured:
    """Share of the pairs of moving vehicles within 12.5 m of some distances that nothing hides from each other.

    Parameters
    ----------
    trees, bodies
        Whether trees hide by their prisms, and road users and parked cars by their footprints, besides the buildings.
    every_s
        Time between the moments that count.

    Notes
    -----
    Lines run between points 0.1 m above the roofs, where antennas are. A body blocks whatever its height, as in TR
    37.885, which counts such links as blocked by a vehicle and decides by heights how much is lost.
    """
    far = np.array(distance_m, float)
    rows = []
    for run in runs:
        config = config_of(run)
        city = city_of(config)
        walls = WallIndex.of(city.buildings)
        name = run.table("vehicles", ["vehicle", "sumo_id"]).set_index("vehicle").sumo_id
        steps = np.arange(0, int(run.manifest["steps"]), max(1, round(every_s / run.dt_s)))
        clear, n = np.zeros(len(far)), np.zeros(len(far))
        for world in worlds(run, config, steps):
            moving = ~name.reindex(world.actor).str.startswith(PARKED).to_numpy(bool)
            row = np.flatnonzero(moving & (world.shape <= Shape.BUS))
            xy = world.boxes.xyz_m[row, :2]
            a, b = row[cKDTree(xy).query_pairs(float(far.max()) + 12.5, output_type="ndarray")].reshape(-1, 2).T
            away = np.hypot(*(world.boxes.xyz_m[a, :2] - world.boxes.xyz_m[b, :2]).T)
            seen = los_between_actors(
                walls, world.boxes, world.shape, a, b, 0.1, bodies=False, city=city if trees else None
            )
            if bodies:
                top = world.boxes.xyz_m + np.array([0, 0, 0.1]) + 0.5 * world.boxes.lwh_m * [0, 0, 1]
                other = Bodies(world.boxes.xyz_m, world.boxes.lwh_m, world.boxes.yaw_rad, np.arange(len(world)))
                seen &= tallest_blocker_m(top, a, b, other) == 0
            here = np.abs(away - far[:, None]) <= 12.5
            clear, n = clear + (here & seen).sum(axis=1), n + here.sum(axis=1)
        rows.append(clear / n)
    return Measured.of_replicates(rows)
