"""What vehicles state of the accuracy of their detections is true of them."""

import numpy as np
import pytest

from cosim.config.config import load
from cosim.messages.content import SELF, SENSED, Detections
from cosim.runs.simulation import Simulation
from cosim.step.accuracy import aged
from sensors.tracking.params import TrackingParams
from tests.sensors.town import boxes_at

SETTINGS = ("preset=modern", "traffic.duration_s=6", "traffic.warmup_s=200", "trust.matching=gates", "attacks=[]",
            "fleet.penetration_p=1")  # fmt: skip


@pytest.fixture(scope="module")
def drive():
    """As `driven`, in the default world: messages say what the standard's confidence values can say."""
    return driven()


@pytest.fixture(scope="module")
def exactly():
    """As `driven`, with messages that say any number."""
    return driven("cpm.accuracy=exact")


def driven(*sets):
    """Per detection of an actor: class (-1 for self reports), range, squared normalised errors of position (over 2),
    heading (modulo pi) and length; how far it drove until the sensor looked there, if its velocity is stated, and the
    error along its heading. Per fused object of an actor: class, range, number of sources, squared normalised
    error over 2."""
    found, fused = [], []
    with Simulation(load(None, (*SETTINGS, *sets))) as simulation:
        for result in simulation:
            sensed = result.result.sensed
            if sensed is not None:
                found.append(of_detections(sensed, result.world))
                fused.append(of_fused(sensed, result.world))
    return np.concatenate(found, axis=1), np.concatenate(fused, axis=1)


def over_two(x, y, variance_m2):
    """Squared normalised error in the plane, over 2."""
    xx, xy, yy = variance_m2.T
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy) / 2


def of_detections(sensed, world):
    objects, truth = sensed.listed.objects, sensed.listed.truth
    who = objects.observer.astype(np.int64) << 32 | truth.actor_row
    _, first, n = np.unique(who, return_index=True, return_counts=True)
    rows = np.intersect1d(first[n == 1], np.flatnonzero(truth.is_real))  # without second boxes of one object
    actor, boxes = truth.actor_row[rows], objects.boxes.take(rows)
    x, y = (boxes.xyz_m[:, :2] - world.boxes.xyz_m[actor, :2]).T
    range_m = np.hypot(*(boxes.xyz_m[:, :2] - world.boxes.xyz_m[objects.observer[rows], :2]).T)
    turn = np.mod(boxes.yaw_rad - world.boxes.yaw_rad[actor] + np.pi / 2, np.pi) - np.pi / 2
    longer = np.log(boxes.lwh_m[:, 0] / world.boxes.lwh_m[actor, 0])
    label = np.where(objects.origin[rows] == SELF, -1, objects.label[rows].astype(int))
    label[objects.label[rows] != world.label[actor]] = -2  # confused
    after_s = sensed.positioned.observed.sweeps.seen_after_s(
        np.searchsorted(sensed.sensing.row, objects.observer[rows]), boxes.xyz_m
    )
    drove_m = np.abs(after_s * world.speed_mps[actor] * np.isfinite(objects.velocity_mps[rows, 0]))
    along_m = np.cos(world.boxes.yaw_rad[actor]) * x + np.sin(world.boxes.yaw_rad[actor]) * y
    with np.errstate(divide="ignore", invalid="ignore"):
        heading, length = turn**2 / objects.heading_variance[rows], longer**2 / objects.size_variance[rows]
    square = over_two(x, y, objects.variance_m2[rows])
    return np.stack([label, range_m, square, heading, length, drove_m, along_m])


def of_fused(sensed, world):
    """Errors relative to the receiver, whose pose error is known here: where it believes to be, and what it believes.

    Objects of which the receiver, or another vehicle in a message, has two boxes are left out, as above.
    """
    fused, truth, senses = sensed.fused()[0], sensed.known.truth, sensed.sensing.row
    actor, ego = truth.actor_row[fused.seed], senses[fused.ego]
    key = fused.ego.astype(np.int64) << 32 | actor
    _, inverse, n = np.unique(key, return_inverse=True, return_counts=True)
    rows = np.flatnonzero(
        truth.is_real[fused.seed] & (n[inverse] == 1) & (world.label[actor] == sensed.known.objects.label[fused.seed])
    )
    actor, ego = actor[rows], ego[rows]
    error = sensed.positioned.error[sensed.vehicles.senses][fused.ego[rows]]
    away = world.boxes.xyz_m[actor, :2] - world.boxes.xyz_m[ego, :2]
    believed = away + error[:, :2] + error[:, 2:] * np.column_stack([-away[:, 1], away[:, 0]])
    x, y = (fused.box[rows, :2] - world.boxes.xyz_m[ego, :2] - believed).T
    return np.stack([
        world.label[actor], np.hypot(*away.T), fused.n_sources[rows], over_two(x, y, fused.variance_m2[rows]),
    ])  # fmt: skip


def test_where_a_roadside_unit_stands_is_known():
    """Position errors of 5 m have a variance of 25 m2 along each axis, of which matching counts 4 m2 (`bounded`)."""
    sets = [*SETTINGS, "traffic.duration_s=2", "gnss.std_m=5", "roadside.0.junctions=3"]
    stated_m2 = {True: [], False: []}
    with Simulation(load(None, sets)) as simulation:
        for result in simulation:
            if (sensed := result.result.sensed) is not None:
                objects = sensed.listed.objects
                for is_roadside, found in stated_m2.items():
                    rows = result.world.is_roadside[objects.observer] == is_roadside
                    found.append(objects.variance_m2[rows, 0])
    of_units, of_vehicles = (np.concatenate(stated_m2[is_roadside]) for is_roadside in (True, False))
    assert (of_vehicles == 4.0).mean() > 0.99
    assert len(of_units) > 50 and np.median(of_units) < 0.5


@pytest.mark.parametrize("label", [-1, 0, 1], ids=["self", "car", "pedestrian"])
def test_normalised_errors_have_unit_variance(drive, label):
    """The squared error in units of the variance is 2 on average, in two dimensions. The median is that of an
    exponential distribution, 2 ln 2; confused classes are in the tail, so the mean is taken up to the 97th percentile,
    where that of an exponential distribution of mean 1 is 1 - 0.03 x ln(1 / 0.03) / 0.97 = 0.89."""
    square = drive[0][2][drive[0][0] == label]
    assert len(square) > 150
    assert 0.8 < np.median(square) / np.log(2) < 1.25
    core = square[square <= np.quantile(square, 0.97)]
    assert 0.8 < core.mean() / 0.89 < 1.25
    for factor in (0.5, 2.0):  # a variance that is twice or half as large is noticed
        assert not 0.8 < np.median(square / factor) / np.log(2) < 1.25


def test_cars_are_reported_where_they_were_at_the_time_of_the_sweep(drive):
    """A sensor looks up to half a turn after that time. Cars with a known velocity that drove 0.3 m and more until
    then are no farther off along their heading than those that stood: the position error of the vehicle is 0.2 m."""
    label, _, _, _, _, drove_m, along_m = drive[0]
    far, near = (np.median(np.abs(along_m[(label == 0) & some])) for some in (drove_m > 0.3, drove_m < 0.03))
    assert (drove_m[label == 0] > 0.3).sum() > 50
    assert far < min(1.25 * near, 0.3)


@pytest.mark.parametrize("label", [0, 1], ids=["car", "pedestrian"])
@pytest.mark.parametrize("what", [3, 4], ids=["heading", "length"])
def test_headings_and_sizes_have_the_stated_variance(exactly, label, what):
    """The median of a squared standard normal number is 0.455. Half and twice the variance are noticed. The standard's
    values are rounded up, which is much for sizes."""
    square = exactly[0][what][exactly[0][0] == label]
    for factor, is_true in ((1.0, True), (0.5, False), (2.0, False)):
        assert (0.8 < np.median(square) / factor / 0.455 < 1.25) == is_true


@pytest.mark.parametrize("label", [0, 1], ids=["car", "pedestrian"])
def test_fused_objects_have_the_stated_variance(drive, label):
    """Objects with several detections, near and far: the mean squared normalised error without the largest 3 %, which
    are confused objects. That of an exponential distribution of mean 1 is 0.89, as above. Given their scores, errors
    have shorter tails, for which it is up to 1. Errors of one object persist over the six seconds, so that finer bins
    scatter."""
    of, range_m, n_sources, square = drive[1]
    rows = (of == label) & (n_sources > 1)
    found = []
    for low, high in ((0, 50), (50, 200)):
        there = square[rows & (range_m >= low) & (range_m < high)]
        assert len(there) > 100
        found.append(there[there <= np.quantile(there, 0.97)].mean() / 0.94)
    assert all(0.8 < value < 1.25 for value in found), found
    for factor in (0.5, 2.0):
        assert not all(0.8 < value / factor < 1.25 for value in found)


@pytest.fixture(scope="module")
def beside_a_motorway():
    """Of cars and trucks without a track in Königs Wusterhausen: own speed, squared error of the velocity along each
    axis (a receiver takes 0), and the stated variance, both as means of the axes."""
    city = [*SETTINGS, "traffic.scenario=koenigs-wusterhausen", "fleet.penetration_p=0.5", "traffic.duration_s=20"]
    found = []
    with Simulation(load(None, city)) as simulation:
        for result in simulation:
            sensed, world = result.result.sensed, result.world
            if sensed is not None:
                objects, truth = sensed.listed.objects, sensed.listed.truth
                is_new = truth.is_real & (objects.origin == SENSED) & np.isnan(objects.velocity_mps).any(axis=1)
                rows = np.flatnonzero(is_new & np.isin(objects.label, (0, 3)))
                own_mps, mps = world.speed_mps[objects.observer[rows]], world.speed_mps[truth.actor_row[rows]]
                xx, _, yy = objects.velocity_variance[rows].T
                found.append(np.stack([own_mps, mps**2 / 2, (xx + yy) / 2]))
    return np.concatenate(found, axis=1)


@pytest.mark.verify
@pytest.mark.parametrize("low_mps, high_mps", [(-1, 10), (10, 20), (20, 60)])
def test_speeds_of_untracked_objects_have_the_stated_variance(beside_a_motorway, low_mps, high_mps):
    """Slow observers beside a motorway expect fast cars, as fast observers do."""
    own_mps, square, variance = beside_a_motorway
    rows = (own_mps > low_mps) & (own_mps <= high_mps)
    assert rows.sum() > 150
    for factor, is_true in ((1.0, True), (0.5, False), (2.0, False)):
        assert (0.8 < square[rows].mean() / (factor * variance[rows].mean()) < 1.25) == is_true


def test_age_adds_the_variance_of_the_motion():
    """A car whose velocity east is known to 0.5 m/s, and north to 1 m/s, after 0.4 s: 0.25 x 0.16 = 0.04 and 0.16, and
    3 x 0.064 / 3 = 0.064 by the random acceleration of cars that accelerate (here 3 m2/s3)."""
    boxes = boxes_at((0.0, 0.0, 0.0))
    one = Detections(
        observer=np.zeros(1, int), detection_index=np.ones(1, int), label=np.zeros(1, np.uint8), boxes=boxes,
        score=np.ones(1), n_points=np.ones(1, int), origin=np.zeros(1, np.uint8), transmitted=np.ones(1, bool),
        variance_m2=np.array([[0.1, 0.02, 0.2]]), velocity_variance=np.array([[0.25, 0.0, 1.0]]),
    )  # fmt: skip
    found = aged(one, np.array([0.4]), TrackingParams(acceleration_noise=(3.0, 1.0, 1.0, 1.0)))
    np.testing.assert_allclose(found.variance_m2, [[0.204, 0.02, 0.424]])


def test_the_table_is_what_lists_state():
    """A self report is as uncertain as the pose; what stands farther off is less certain by the heading of the pose."""
    with Simulation(load(None, ("preset=modern", "traffic.duration_s=2", "traffic.warmup_s=60"))) as simulation:
        *_, result = simulation
        table = result.table("stated_accuracies").set_index(["observer", "detection_index"])
        listed = result.table("detections").set_index(["observer", "detection_index"])
    assert table.index.equals(listed.index) and len(table) > 20
    own = table[listed.origin == "self"]
    assert len(own) and own.x_std_m.to_numpy() == pytest.approx(0.2, abs=1e-3) and (own.relative_x_std_m == 0).all()
    seen = table[listed.origin == "sensed"]
    assert (seen[["x_std_m", "y_std_m"]] > 0.2).all(axis=None) and seen.xy_correlation.abs().max() <= 1
