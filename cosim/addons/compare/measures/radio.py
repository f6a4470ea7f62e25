"""Propagation, reception, lines of sight, and lengths of messages."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.base.codes import OBJECT, PARKED
from cosim.messages.cpm import object_bits
from cosim.radio.bodies import Bodies, tallest_blocker_m
from cosim.radio.channel import AccessParams, ChannelRules, ChannelState, Links, Packets, PhyOutcome, run_window
from cosim.radio.phy import ReceiverParams, airtime_ns
from cosim.radio.propagation import blockage_mean_db, fading_class, log_distance_db, tr37885_db
from cosim.runs.replay_lidar import city_of, config_of, worlds
from results.run import Run
from sensors.line_of_sight import WallIndex, los_between_actors
from sensors.scene import Shape

MEASURES = (
    "frame_airtime",
    "path_loss",
    "blockage",
    "delivery_of_one_sender",
    "reception_around_corner",
    "range_around_corner",
    "range_in_the_open",
    "object_bytes",
    "sight_past_buildings",
    "sight_past_everything",
)

_OBJECT = ("objectId", "angles", "objectDimensionZ", "objectDimensionY", "objectDimensionX", "classification")
"""Optional members of every perceived object here: identity, heading, size and class."""
_PERIOD_NS = 10_000_000
_N_PACKETS = 4000
_DCF = AccessParams(aifsn=(2, 2, 2, 2), cw=(15, 15, 15, 15))


def frame_airtime(*, payload_bytes: Sequence[int], rate_mbps: float) -> Float[ndarray, "k"]:
    """Time on air of a frame [us]."""
    return airtime_ns(np.array(payload_bytes), rate_mbps) / 1000


def path_loss(*, scenario: str, nlos: bool, distance_m: Sequence[float]) -> Float[ndarray, "k"]:
    """Path loss of TR 37.885 without shadowing and blockage [dB]."""
    d = np.array(distance_m, float)
    return tr37885_db(d, np.full(len(d), nlos), "urban" if scenario == "urban" else "highway")


def blockage(*, heights_m: Sequence[Sequence[float]], distance_m: float) -> Float[ndarray, "k"]:
    """Mean loss behind a vehicle of 1.6 m by the heights of the two antennas [dB]."""
    a, b = np.array(heights_m, float).T
    return blockage_mean_db(np.full(len(a), distance_m), a, b)[0]


def delivery_of_one_sender(*, distance_m: Sequence[float], p_min_dbm: float) -> Float[ndarray, "r k"]:
    """Packet delivery ratio by distance, of one sender with Nakagami fading and the loss of distance to 2.75.

    Each value is the mean over five receivers 5 m apart around the distance.
    """
    beside_m = 5.0 * np.arange(-2, 3)
    away = np.array(distance_m, float)[:, None] + beside_m
    loss_db = log_distance_db(away.ravel(), 2.75)
    received = _received(loss_db, away.ravel(), 300, ReceiverParams(p_min_dbm=p_min_dbm), 23.0)
    return received.reshape(len(away), -1).T


def reception_around_corner(
    *,
    sender_m: Sequence[float],
    receiver_m: float,
    power_dbm: float,
    loss_db: float,
    payload_bytes: int,
    rate_mbps: float,
    corners: int = 400,
) -> Float[ndarray, "c k"]:
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
    return _behind_corners(away, corners, payload_bytes, receiver, power_dbm, loss_db).T


def range_around_corner(
    *, sender_m: Sequence[float], least: float, payload_bytes: int, corners: int = 100
) -> Float[ndarray, "4 k"]:
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
        replicate = np.arange(4)
        near = mean[below - 1, replicate]
        far = mean[below, replicate]
        too_far_m = 5.0 * (least - far) / (near - far)
        rows.append(receiver_m[below] - too_far_m)
    return np.array(rows).T


def _behind_corners(
    away_m: Float[ndarray, "k"],
    corners: int,
    payload_bytes: int,
    receiver: ReceiverParams,
    power_dbm: float,
    loss_db: float,
) -> Float[ndarray, "k c"]:
    """Share of frames received without line of sight at each distance, behind each of many corners."""
    draws = np.random.default_rng(1).normal(size=(len(away_m), corners))
    is_nlos = np.ones(len(away_m), bool)
    mean_db = tr37885_db(away_m, is_nlos, "urban") + loss_db
    loss = mean_db[:, None] + 4.0 * draws  # dB, TR 37.885
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
    n, packets = len(power), np.arange(n_packets)
    ones = np.ones(n_packets, np.int64)
    ptr = np.concatenate([[0], np.full(n + 1, n)])
    names = np.arange(1, n + 2, dtype=np.uint64)
    fading = fading_class(away_m, "nakagami")
    links = Links(names, ptr, np.arange(1, n + 1), power, fading)
    sent = Packets(
        sender=0 * ones,
        seq=packets.astype(np.uint64),
        generated_ns=packets * _PERIOD_NS,
        payload_bytes=payload_bytes * ones,
        access=np.full(n_packets, 2, np.uint8),
        lifetime_ns=10 * _PERIOD_NS * ones,
        tag=packets,
    )
    rules = ChannelRules(np.uint64(1), receiver, _DCF)
    _, out = run_window(ChannelState.start(), links, sent, n_packets * _PERIOD_NS, rules)
    by = out.receiver[out.reception == PhyOutcome.RECEIVED]
    return np.bincount(by, minlength=n + 1)[1:] / n_packets


def range_in_the_open(*, least: float, payload_bytes: int, rate_mbps: float) -> list[float]:
    """Distance up to which vehicles in line of sight on a highway receive the least share of frames [m]."""
    away = np.arange(50.0, 3001.0, 50.0)
    loss_db = tr37885_db(away, np.zeros(len(away), bool), "highway")
    share = _received(loss_db, away, payload_bytes, ReceiverParams(rate_mbps=rate_mbps), 23.0, 1000)
    return [float(away[share >= least].max(initial=0.0))]


def object_bytes(*, more: Sequence[Sequence[str]]) -> list[float]:
    """Length of one perceived car in a CPM of release 2 with these further members [B]."""
    return [object_bits((*_OBJECT, *members))[0] / 8 for members in more]


def sight_past_buildings(run: Run, *, distance_m: Sequence[float]) -> Float[ndarray, "k"]:
    """Share of the pairs of vehicles at some distances that no building hides from each other."""
    table = run.pdr_by_distance
    table = table[table.los_state.isin(["los", "nlos"])]
    by = table.groupby(["distance_bin_m", "los_state"], observed=True).n_in_range.sum().unstack(fill_value=0)
    share = by.get("los", 0) / by.sum(axis=1)
    edge = share.index.to_numpy(float)
    middle_m = edge + np.diff(edge).min() / 2
    return np.interp(distance_m, middle_m, share.to_numpy(float))


def sight_past_everything(
    run: Run, *, distance_m: Sequence[float], trees: bool = True, bodies: bool = True, every_s: float = 20.0
) -> Float[ndarray, "k"]:
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
    config = config_of(run)
    city = city_of(config)
    walls = WallIndex.of(city.buildings)
    name = run.table("vehicles", ["vehicle", "sumo_id"]).set_index("vehicle").sumo_id
    every = max(1, round(every_s / run.dt_s))
    steps = np.arange(0, int(run.manifest["steps"]), every)
    clear, n = np.zeros((2, len(far)))
    for world in worlds(run, steps):
        moving = ~name.reindex(world.actor).str.startswith((PARKED, OBJECT)).to_numpy(bool)
        row = np.flatnonzero(moving & (world.shape <= Shape.BUS))
        boxes = world.boxes
        tree = cKDTree(boxes.xyz_m[row, :2])
        pairs = tree.query_pairs(float(far.max()) + 12.5, output_type="ndarray")
        a, b = row[pairs].T
        between = boxes.xyz_m[a, :2] - boxes.xyz_m[b, :2]
        away = np.hypot(*between.T)
        woods = city if trees else None
        seen = los_between_actors(walls, boxes, world.shape, a, b, 0.1, bodies=False, city=woods)
        if bodies:
            half_height = 0.5 * boxes.lwh_m * [0, 0, 1]
            top = boxes.xyz_m + [0, 0, 0.1] + half_height
            other = Bodies(boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad, np.arange(len(world)))
            seen &= tallest_blocker_m(top, a, b, other) == 0
        here = np.abs(away - far[:, None]) <= 12.5
        clear += (here & seen).sum(axis=1)
        n += here.sum(axis=1)
    return clear / n
