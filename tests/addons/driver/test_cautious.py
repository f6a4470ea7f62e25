"""The cautious driver by hand: positions, speeds and decelerations derived in comments."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.addons.driver.cautious import Cautious, CautiousParams
from cosim.addons.driver.lane_path import ahead_on_path
from cosim.traffic.driver import Beliefs
from cosim.world import LABELS, LanePaths, World
from sensors.boxes import Boxes
from sensors.scene import Shape
from tests.sensors.town import boxes_at

CAR, PEDESTRIAN = LABELS.index("car"), LABELS.index("pedestrian")
NOW = CautiousParams(reaction_s=0.0)


def world(fronts_m, speeds_mps, step=0):
    """Cars of 5 m x 2 m x 1.5 m on one lane along +x; all equipped."""
    n = len(fronts_m)
    xyz = np.column_stack([np.array(fronts_m, float) - 2.5, np.zeros(n), np.full(n, 0.75)])
    boxes = boxes_at(xyz, (5.0, 2.0, 1.5))
    line = np.array([[0.0, 0.0], [1000.0, 0.0]])
    paths = LanePaths(
        np.arange(n), np.zeros(n, int), np.array(fronts_m, float), np.array([0, 2]), line, np.array([0.0, 1000.0])
    )
    return World(
        step, np.arange(n, dtype=np.int32), np.arange(n).astype(np.uint64), np.full(n, Shape.CAR, np.uint8), boxes,
        np.array(speeds_mps, float), np.ones(n, bool), np.zeros(n, np.uint8), paths,
    )  # fmt: skip


def belief(
    ego, x_m, label=PEDESTRIAN, yaw=0.0, lwh=(0.8, 0.6, 1.75), y_m=0.0, score=1.0, own=False, known_s=0.0, sent=0
):
    return Beliefs(
        known_s, np.array([ego]), np.array([label], np.uint8),
        boxes_at((x_m, y_m, lwh[2] / 2), lwh, yaw), np.array([score]),
        np.array([own]), np.array([7]), np.array([3]), np.array([sent]),
    )  # fmt: skip


def test_three_vehicles_and_a_ghost_before_the_second():
    """Fronts at 100, 60 and 40 m, all at 10 m/s. The second believes in a person whose near side is 20 m ahead.

    Comfortable deceleration b = 2.5 m/s2, step t = 0.5 s, so b t = 1.25 m/s. Free way 20 - 2.5 = 17.5 m.
    v = -1.25 + sqrt(1.25^2 + 2 x 2.5 x 17.5) = -1.25 + sqrt(89.0625) = 8.18729 m/s, which is
    (10 - 8.18729) / 0.5 = 3.62542 m/s2.
    It drives 8.18729 x 0.5 = 4.09364 m, gap 15.90636 m, free 13.40636 m, and the next speed is
    -1.25 + sqrt(1.5625 + 67.0318) = 7.03217 m/s: 2.31024 m/s2. The first and the third are not commanded.
    """
    driver = Cautious(NOW)
    state, commands = driver.commands(None, world([100, 60, 40], [10, 10, 10]), belief(1, 60 + 20 + 0.4), 0.5)
    assert commands.actor.tolist() == [1]
    np.testing.assert_allclose(commands.speed_mps, [8.18729], atol=1e-5)
    np.testing.assert_allclose(commands.reasons.gap_m, [20.0], atol=1e-9)
    later = world([105, 60 + 4.09364, 45], [10, 8.18729, 10], step=1)
    state, commands = driver.commands(state, later, None, 0.5)
    np.testing.assert_allclose(commands.speed_mps, [7.03217], atol=1e-4)
    assert (commands.reasons.source.tolist(), commands.reasons.source_index.tolist()) == ([7], [3])


def test_no_step_takes_more_than_the_emergency_deceleration():
    """2.5 m ahead there is no free way: wanted 0, given 10 - 4.5 x 0.5 = 7.75 m/s."""
    _, commands = Cautious(NOW).commands(None, world([0], [10]), belief(0, 2.9), 0.5)
    np.testing.assert_allclose(commands.speed_mps, [7.75])


def test_reaction_and_release():
    """Fused at 0.4 s, reaction 0.5 s: commands from 0.9 s on, so at step 2 (1.0 s). Last believed in the sweep at
    0 s, release 1 s: the last command is that of step 2."""
    driver, state, given = Cautious(CautiousParams()), None, []
    for step in range(5):
        seen = belief(0, 30.4, known_s=0.4) if step == 0 else None
        state, commands = driver.commands(state, world([5.0 * step], [10], step), seen, 0.5)
        given.append(len(commands))
    assert given == [0, 0, 1, 0, 0]


def test_a_car_that_drives_along_needs_a_second_sweep_and_one_that_faces_the_driver_does_not():
    """Two sweeps 0.5 s apart show the car 5 m on: 10 m/s. Its rear is 12.5 m ahead: free 10 m.
    v = -1.25 + sqrt(1.5625 + 100 + 50) = 11.06 m/s: slower than what a car at 10 m/s could reach (11.3).
    One that faces the driver counts as standing: v = -1.25 + sqrt(51.5625) = 5.93 m/s, given 10 - 4.5 x 0.5 = 7.75."""
    size = (5.0, 2.0, 1.5)
    driver = Cautious(NOW)
    first, second = belief(0, 15.0, CAR, lwh=size), belief(0, 20.0, CAR, lwh=size, sent=1)
    state, commands = driver.commands(None, world([0], [10]), first, 0.5)
    assert len(commands) == 0
    _, commands = driver.commands(state, world([5], [10], 1), second, 0.5)
    np.testing.assert_allclose(commands.speed_mps, [-1.25 + np.sqrt(151.5625)])
    _, commands = driver.commands(None, world([0], [10]), replace(first, boxes=facing(first.boxes)), 0.5)
    np.testing.assert_allclose(commands.speed_mps, [7.75])


def test_a_message_that_is_fused_again_shows_no_speed():
    """A car at 8 m/s reports itself every second, and the vehicle behind it, as fast, senses every 0.2 s.

    From the second message on, the car is one object at 8 m/s, where it is now; it is never taken to stand.
    """
    driver, state = Cautious(NOW), None
    for step in range(16):
        sent = step // 5 * 5
        told = belief(0, 20 + 8 * sent * 0.2, CAR, lwh=(5.0, 2.0, 1.5), sent=sent)
        state, commands = driver.commands(state, world([8 * step * 0.2], [8], step), told, 0.2)
        assert len(state) == 1 and len(commands) == 0
        if step >= 5:
            np.testing.assert_allclose(state.velocity_mps, [[8.0, 0.0]])
            np.testing.assert_allclose(state.xy_m, [[20 + 8 * step * 0.2, 0.0]])


def facing(boxes):
    return Boxes(boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad + np.pi)


@pytest.mark.parametrize(
    "spared",
    [
        belief(0, 20.0, own=True),  # the own detector reports it: SUMO's business
        belief(0, 20.0, score=0.1),
        belief(0, 20.0, y_m=1.9),  # 1.9 - 0.3 = 1.6 m beside the path
        belief(0, -3.0),  # behind
        belief(0, 60.0),  # beyond 4 s at 10 m/s
        replace(belief(0, 20.0), boxes=boxes_at((20.0, 0, 8.0), (0.8, 0.6, 1.75))),
    ],
)
def test_what_is_not_in_the_way_commands_nothing(spared):
    assert len(Cautious(NOW).commands(None, world([0], [10]), spared, 0.5)[1]) == 0


def test_share_is_decided_by_name():
    """Every believer has the same ghost; a share of 0.3 of 2000 reacts, and all of them at a larger share too."""
    n = 2000
    worlds = world(np.zeros(n), np.full(n, 10.0))
    one = belief(0, 20.0)
    boxes = one.boxes.take(np.zeros(n, int))
    many = Beliefs(0.0, np.arange(n), np.full(n, PEDESTRIAN, np.uint8), boxes, np.ones(n), np.zeros(n, bool),
                   np.full(n, 7), np.full(n, 3), np.zeros(n, int))  # fmt: skip
    few, more = (Cautious(replace(NOW, share_p=p)).commands(None, worlds, many, 0.5)[1].actor for p in (0.3, 0.6))
    assert 520 < len(few) < 680 and np.isin(few, more).all()


def test_paths_turn_at_junctions():
    """A lane 30 m east, then 30 m north. From 20 m along it, a person at (30, 8) is 10 + 7.6 m ahead; one straight on,
    at (40, 0), is not in the way, nor is one 5 m inside the corner."""
    xy = np.array([[0.0, 0], [30, 0], [30, 30]])
    paths = LanePaths(
        np.zeros(1, int), np.zeros(1, int), np.array([20.0]), np.array([0, 3]), xy, np.array([0, 30.0, 60])
    )
    where = np.array([[30.0, 8.0], [40.0, 0.0], [25.0, 5.0]])
    gap, heading = ahead_on_path(
        paths, np.zeros(3, int), where, np.tile([0.8, 0.6], (3, 1)), np.full(3, np.pi / 2), np.full(3, 40.0), 1.5
    )
    np.testing.assert_allclose(gap, [17.6, np.inf, np.inf])
    np.testing.assert_allclose(heading[0], np.pi / 2)


def test_persons_who_step_out():
    """A person at y = -4 m walks at 1.4 m/s towards the path: two sweeps 0.5 s apart show it at -4.0 and -3.3 m.
    In 2 s it is at -0.5 m, in the corridor; without looking ahead nothing is commanded."""
    for ahead_s, n in ((2.0, 1), (0.0, 0)):
        driver = Cautious(replace(NOW, persons_ahead_s=ahead_s))
        state, _ = driver.commands(None, world([0], [10]), belief(0, 25.0, y_m=-4.0), 0.5)
        _, commands = driver.commands(state, world([5], [10], 1), belief(0, 25.0, y_m=-3.3, sent=1), 0.5)
        assert len(commands) == n


def test_persons_of_the_own_detector():
    """They command only where asked for; SUMO's drivers do not see them beside crossings."""
    for own, n in ((True, 1), (False, 0)):
        driver = Cautious(replace(NOW, own_persons=own))
        assert len(driver.commands(None, world([0], [10]), belief(0, 20.0, own=True), 0.5)[1]) == n
