"""Early fusion within the cycle: without partners it is the own detections, and returns are those of the partners."""

import numpy as np
import pytest

from cosim.addons.compare.scenarios import FOLDER, ScriptedScene
from cosim.config.config import load
from cosim.config.effect import without_effect
from cosim.messages.content import SENSED
from cosim.radio.message_round import MessageRound, Messages, Stations
from cosim.runs.checkpoint import decode, encode
from cosim.step.cycle import step
from cosim.step.early_fusion import Clouds
from cosim.step.parts import Parts
from cosim.step.state import State
from results.archive import open_run
from tests.drive import drive, noted
from tests.fingerprint import fingerprint
from tests.refusals import refused_in_one_line
from tests.scene import QUIET, assert_same

WRONG = ("gnss.std_m=0.3", "gnss.heading_std_deg=1", "lidar.rotation_hz=10")


def played(n, *overrides, kept=lambda state: state):
    """Steps of the paper's scene with the detector of the config; `kept` is done with each state between two steps."""
    overrides = ("early_fusion.medium=unlimited", "early_fusion.share=objects", *overrides)
    scene = ScriptedScene.load()
    parts = Parts.of(load(FOLDER / "scenario-2.toml", [*QUIET, *overrides]), scene.city)
    state, sensed = State.start(parts), []
    for number in range(n):
        state, result = step(scene.world(number), kept(state), parts)
        sensed.append(result.sensed)
    return sensed


@pytest.mark.parametrize("sets", [(), WRONG])
def test_without_partners_it_is_the_own_detections_in_every_bit(sets):
    for sensed in played(3, "early_fusion.partners=0", *sets):
        own, early = sensed.positioned.observed, sensed.early
        rows = np.flatnonzero(own.detections.origin == SENSED)
        d = own.detections.take(rows)
        assert len(rows) > 2
        np.testing.assert_array_equal(sensed.sensing.row[early.ego], d.observer)
        for name in ("label", "score"):
            np.testing.assert_array_equal(getattr(early, name), getattr(d, name))
        for name in ("xyz_m", "lwh_m", "yaw_rad"):
            np.testing.assert_array_equal(getattr(early.boxes, name), getattr(d.boxes, name))
        np.testing.assert_array_equal(early.is_real, own.is_real)
        np.testing.assert_array_equal(early.actor_row[early.is_real], own.actor_row[own.is_real])
        assert (early.n_sweeps == 1).all()


def test_returns_of_all_in_range_count_together():
    """A literal sum over the sweeps of all vehicles, but for returns from the ego itself."""
    n_more = 0
    for sensed in played(3):
        seen, early = sensed.positioned.observed.observability, sensed.early
        row = sensed.sensing.row
        for k in np.flatnonzero(early.is_real):
            assert early.actor_row[k] != row[early.ego[k]]
            of = seen.n_returns[seen.actor == early.actor_row[k]]
            assert (early.n_points[k], early.n_sweeps[k]) == (of.sum(), (of > 0).sum())
            n_more += early.n_sweeps[k] > 1
        assert (early.n_received == early.n_in_range).all() and early.n_in_range.sum() > 0
        assert early.offered.n_points.tolist() == np.bincount(seen.observer, seen.n_returns, len(row)).tolist()
    assert n_more > 3


def test_with_exact_poses_nothing_is_lost_and_some_is_won():
    """A draw finds an object if it is below a probability that grows with returns and falls with occlusion."""
    won = 0
    for alone, together in zip(played(5, "early_fusion.partners=0"), played(5), strict=True):
        found = [
            set(zip(e.ego[e.is_real].tolist(), e.actor_row[e.is_real].tolist(), strict=True))
            for e in (alone.early, together.early)
        ]
        assert found[0] <= found[1]
        won += len(found[1] - found[0])
    assert won > 0


def test_a_checkpoint_keeps_the_clouds():
    """Each state is written and read again; clouds of up to two steps ago are still used."""
    sets = ("early_fusion.max_age_s=2", *WRONG)
    whole, resumed = (
        played(4, *sets, kept=kept) for kept in (lambda s: s, lambda s: decode(b"".join(map(bytes, encode(s)))))
    )
    assert_same([s.early for s in whole], [s.early for s in resumed])


def test_errors_of_partners_displace_and_lengthen_boxes():
    (exact,), (off,) = (played(1, *sets) for sets in ((), ("gnss.std_m=0.5",)))
    pairs = [set(zip(e.early.ego.tolist(), e.early.score.tolist(), strict=True)) for e in (exact, off)]
    assert pairs[0] == pairs[1], "errors change no returns"
    assert (off.early.boxes.lwh_m[:, :2] > exact.early.boxes.lwh_m[:, :2] + 0.01).any()


def test_a_whole_sweep_has_all_its_returns():
    (sensed,) = played(1, "early_fusion.share=sweep")
    images = sensed.positioned.observed.sweeps
    n = [int(images.has_return(o).sum()) for o in range(len(sensed.sensing))]
    assert sensed.early.offered.n_points.tolist() == n and min(n) > 1000
    assert sensed.early.offered.length_bytes.tolist() == [186 + 16 * k for k in n]


def test_the_radio_carries_clouds_and_leaves_the_detection_messages_alone():
    """`unit_disk` without losses carries any length; each cloud is then received by all in range."""
    with_clouds, without = (
        played(2, "early_fusion.medium=radio", f"early_fusion.share={s}") for s in ("sweep", "none")
    )
    for one, other in zip(with_clouds, without, strict=True):
        assert other.early is None
        np.testing.assert_array_equal(one.early.n_received, one.early.n_in_range)
        assert one.early.n_frames.tolist() == [1] * len(one.sensing)
        for name in ("receiver", "message", "latency_s"):
            a, b = (getattr(x.rounds[0].round.receptions, name) for x in (one, other))
            np.testing.assert_array_equal(a, b)
        assert len(one.rounds[0].round.frames.message) == len(other.rounds[0].round.frames.message)


def test_messages_behind_others_by_hand():
    messages, is_other = Messages(np.array([0, 0, 2, 3]), np.array([5, 6, 7, 8])).followed_by(
        Messages(np.array([0, 1, 3]), np.array([100, 200, 300]))
    )
    assert messages.station.tolist() == [0, 0, 0, 1, 2, 3, 3]
    assert messages.length_bytes.tolist() == [5, 6, 100, 200, 7, 8, 300]
    assert np.flatnonzero(is_other).tolist() == [2, 3, 6]
    stations = Stations(np.arange(4, dtype=np.uint64), np.zeros((4, 3)), 4)
    happened = MessageRound.of(stations, messages, np.array([1, 1, 2, 3]), np.array([0, 2, 3, 4]))
    first, others = happened.only(~is_other), happened.only(is_other)
    assert first.receptions.message.tolist() == [0, 2] and first.receptions.receiver.tolist() == [1, 3]
    assert others.receptions.message.tolist() == [0, 1] and others.frames.message.tolist() == [0, 1]
    assert others.station.tolist() == [0, 1, 3] and others.frames.n_transmissions.tolist() == [1, 1, 1]


def test_old_clouds_are_forgotten_by_hand():
    one = Clouds(np.array([4]), np.array([7]), np.zeros((1, 2)), np.array([0, 0]), np.array([1, 2]), np.ones(2, int),
                 np.ones(2, int), np.ones(2), np.zeros((2, 2)), np.array([3]), np.array([0]))  # fmt: skip
    both = one.and_also(Clouds(np.array([5]), np.array([8]), np.ones((1, 2)), np.array([0]), np.array([9]),
                               np.ones(1, int), np.ones(1, int), np.ones(1), np.ones((1, 2)), np.array([3, 4]),
                               np.array([0, 0])))  # fmt: skip
    assert both.cloud.tolist() == [0, 0, 1] and both.received.tolist() == [0, 1, 1]
    late = both.since(5)
    assert (late.sender.tolist(), late.actor.tolist(), late.receiver.tolist()) == ([8], [9], [3, 4])
    assert late.cloud.tolist() == [0] and late.received.tolist() == [0, 0] and both.since(4) is both
    # Vehicle 5 receives the cloud of step 4 of vehicle 7 after its round, and vehicle 6 one that is forgotten.
    more = both.with_late(np.array([4, 3]), np.array([7, 7]), np.array([5, 6]))
    assert more.receiver.tolist() == [3, 3, 4, 5] and more.received.tolist() == [0, 1, 1, 0]
    assert more.untold.tolist() == [7, 7]


@pytest.mark.parametrize(
    ("sets", "why"),
    [
        (["detector.model=ideal"], "needs a detector that can be asked about numbers of returns"),
        (["radio.relay.max_hops=3"], "point clouds are not forwarded"),
        (["early_fusion.partners=-1"], "early_fusion.partners"),
        (["early_fusion.share=all"], "early_fusion.share"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(sets, why):
    with refused_in_one_line(why):
        load(None, ["early_fusion.share=sweep", *sets])


def test_keys_without_sharing_have_no_effect():
    assert without_effect(load(None, ["early_fusion.partners=2"]), False) == [
        "early_fusion.partners has no effect without early_fusion.share."
    ]


SETS = ("preset=modern", "traffic.duration_s=2", "attacks=[]", "fleet.penetration_p=0.3", "gnss.std_m=0",
        "gnss.heading_std_deg=0")  # fmt: skip
IDEAL = ("early_fusion.share=objects", "early_fusion.medium=unlimited", "early_fusion.max_age_s=1")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return open_run(drive(tmp_path_factory.mktemp("early") / "run", *SETS, *IDEAL, "compute.threads=1"))


@pytest.mark.verify
def test_clouds_of_earlier_steps_by_a_literal_twin(run):
    """Of each partner the newest sweep of the last second that the ego was near enough to receive, if the ego is within
    70 m of its place now; the four nearest."""
    seen = run.observability[run.observability.n_points > 0]
    points = seen.set_index(["step", "observer", "actor"]).n_points
    of_sweep = seen.groupby(["step", "observer"])
    place = {(a.step, a.actor): np.array([a.x_m, a.y_m]) for a in run.actors.itertuples()}
    equipped = run.vehicles[run.vehicles.equipped].vehicle.tolist()
    real = run.early_fused[run.early_fused.truth_actor.notna()]
    n_old = 0
    for (now, ego), rows in real[real.step >= 5].groupby(["step", "observer"]):
        used = []
        for other in equipped:
            for then in range(now, now - 6, -1):
                if other == ego or (then, other) not in of_sweep.groups or (then, ego) not in place:
                    continue
                if np.hypot(*(place[then, other] - place[then, ego])) <= 70:
                    away = np.hypot(*(place[then, other] - place[now, ego]))
                    used += [(away, other, then)] if away <= 70 else []
                    break
        used = [(now, ego), *((then, other) for _, other, then in sorted(used)[:4])]
        n_old += sum(then < now for then, _ in used)
        for row in rows.itertuples():
            n = [int(points.get((then, who, row.truth_actor), 0)) for then, who in used]
            assert (row.n_points, row.n_sweeps) == (sum(n), sum(k > 0 for k in n))
    assert n_old > 10 and len(real) > 100


@pytest.mark.verify
def test_partners_find_more_and_nothing_else_changes(run, tmp_path):
    known = {which: run.measure.value("detection.awareness_70m.share", which) for which in ("local", "early")}
    assert known["early"] > known["local"]
    alone, other = (
        fingerprint(drive(tmp_path / name, *SETS, *sets))
        for name, sets in (("alone", ()), ("other", (*IDEAL, "record.block_steps=3", "compute.threads=2")))
    )
    mine = fingerprint(run.path)
    assert mine == other
    assert {name for name in mine if mine[name] != alone[name]} == {"early_fused", "clouds"}


@pytest.mark.verify
def test_clouds_go_on_after_their_rounds_and_are_no_detection_messages(tmp_path):
    """A cloud of some twenty frames takes longer than a round of 80 ms. It is received in later steps."""
    world = *SETS, "fleet.penetration_p=0.15", "traffic.duration_s=6"
    clouds = "early_fusion.share=objects", "early_fusion.max_age_s=1"
    run = open_run(drive(tmp_path / "with", *world, *clouds))
    without = open_run(drive(tmp_path / "without", *world))
    of_cpms = [one.radio[one.radio.message_type == "cpm"] for one in (run, without)]
    assert of_cpms[0].n_sent.sum() == pytest.approx(of_cpms[1].n_sent.sum(), rel=0.02)
    assert of_cpms[0].sent_bytes.sum() > 5 * of_cpms[1].sent_bytes.sum()
    assert run.clouds.n_received_late.sum() > 0


def test_a_note_where_most_clouds_are_too_old():
    """In the default world, vehicles sense in five groups one after the other, 0.2 s apart."""

    def of_clouds(*sets):
        return [line for line in noted(*sets) if "early_fusion.max_age_s" in line]

    world = "preset=modern", 'early_fusion.share="objects"'
    (line,) = of_clouds(*world)
    assert "one in 5" in line and "early_fusion.max_age_s = 0.8 merges those of all, and blurs what moves" in line
    assert not of_clouds(*world, "early_fusion.max_age_s=0.8")
    assert not of_clouds("preset=modern")
    assert not of_clouds('early_fusion.share="objects"')  # all sense at once
