"""Vehicles that sense at different times: which messages they use, how old these are, and that nothing is lost."""

import numpy as np
import pandas as pd
import pytest

from cosim import Simulation
from cosim.config.config import load
from cosim.traffic.schedule import Schedule, SensingGroup
from results.archive import open_run
from results.sensing import interval_steps, senses
from sensors.boxes import Boxes, overlapping_pairs, pairs_between
from tests.drive import drive
from tests.fingerprint import fingerprint
from tests.refusals import refused_in_one_line
from tests.sensors.town import random_boxes

RANDOM = ("traffic.step_s=0.2", "sensing_phase=random", "traffic.duration_s=5", "traffic.warmup_s=120",
          "radio.model=unit_disk", "radio.unit_disk.loss_p=0.2", "record.level=full", "attacks.0.start_s=0",
          "attacks.1.start_s=0")  # fmt: skip
N = 5
"""Steps of an interval."""
MIXED = ("sensing_groups=[{share_p=0.4,interval_s=0.4},{share_p=0.2,interval_s=0.2}]",)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return [open_run(drive(folder / "random", *RANDOM, "compute.threads=1")),
            open_run(drive(folder / "mixed", *RANDOM, *MIXED))]  # fmt: skip


def of_vehicle(run, pseudonyms):
    return pseudonyms.map(run.subjects.vehicle).to_numpy(np.int64)


def test_each_vehicle_senses_at_its_own_steps(runs):
    for run in runs:
        own = run.detections[run.detections.detection_index == 0]
        there = run.actors.merge(run.vehicles[run.vehicles.equipped], left_on="actor", right_on="vehicle")
        due = there[senses(run, there.step.to_numpy(), there.actor.to_numpy())]
        got = set(zip(own.step, of_vehicle(run, own.observer), strict=True))
        assert got == set(zip(due.step, due.actor, strict=True)) and len(got) > 100
    assert set(runs[0].vehicles.sensing_phase_steps.dropna()) == set(range(N))
    assert set(runs[1].vehicles.sensing_interval_steps.dropna()) == {1, 2, 5}


def test_what_a_vehicle_says_in_its_first_message_is_heard(runs):
    """It may be of messages that it received before: a vehicle has its pseudonym from when it enters."""
    for run in runs:
        assert run.manifest["summary"]["evaluations_rejected"] == {}
        entered = run.vehicles[run.vehicles.equipped].set_index("vehicle").first_step
        first = run.pseudonyms.groupby("vehicle").from_step.min()
        assert (first == entered[first.index]).all()
        own = run.detections[run.detections.detection_index == 0]
        assert own.groupby(of_vehicle(run, own.observer)).step.min().gt(first).any()


def test_sweeps_per_second_are_those_of_all_groups():
    """Half of the vehicles senses ten times a second, a quarter every two seconds, and the others once a second."""
    groups = SensingGroup(share_p=0.5, interval_s=0.1), SensingGroup(share_p=0.25, interval_s=2.0)
    of_groups = Schedule.of(1.0, "random", groups, 0.1, 1).sweeps_per_s
    assert of_groups == pytest.approx(0.5 * 10 + 0.25 * 0.5 + 0.25 * 1)
    assert Schedule.of(0.5, "common", (), 0.1, 1).sweeps_per_s == pytest.approx(2)


def test_age_of_a_message_in_closed_form(runs):
    """With equal intervals of n steps, a message is (phase of the receiver - phase of the sender) mod n steps old.

    The mean over uniform phases is (n - 1) / 2 steps: 0.4 s for n = 5 and steps of 0.2 s, half an interval less half
    a step.
    """
    run = runs[0]
    phase = run.vehicles.set_index("vehicle").sensing_phase_steps
    rows = run.evaluations
    by, of = of_vehicle(run, rows.evaluator), of_vehicle(run, rows.observer)
    expected = (phase[by].to_numpy(int) - phase[of].to_numpy(int)) % N
    age = (rows.step - rows.detection_step).to_numpy()
    assert (age == expected).all() and len(np.unique(age)) == N
    one, other = np.meshgrid(np.arange(N), np.arange(N))
    assert ((one - other) % N).mean() == (N - 1) / 2


def messages_used(run, message_type):
    """Literal twin of the inbox: (step, receiver, sender's pseudonym, step of the message) of every message in use."""
    received = run.receptions[run.receptions.message_type == message_type]
    box, longest = {}, int(run.vehicles.sensing_interval_steps.max())
    on_road = run.actors.groupby("step").actor.apply(set)
    equipped = run.vehicles[run.vehicles.equipped].vehicle.tolist()
    vehicle = run.subjects.vehicle
    for step in range(int(run.manifest["steps"])):
        for row in received[received.step == step].itertuples():
            box.setdefault(row.receiver, []).append((step, row.sender))
        due = senses(run, np.full(len(equipped), step), np.array(equipped))
        for receiver, is_due in zip(equipped, due, strict=True):
            if is_due and receiver in on_road[step]:
                fresh = [(s, p) for s, p in box.get(receiver, []) if step - s < longest and vehicle[p] in on_road[step]]
                yield from ((step, receiver, p, s) for s, p in fresh)


@pytest.mark.parametrize("which", [0, 1])
def test_messages_in_use_are_those_of_a_literal_inbox(runs, which):
    run = runs[which]
    cpms = pd.DataFrame(messages_used(run, "cpm"), columns=["step", "receiver", "sender", "sent"])
    newest = cpms.groupby(["step", "receiver", "sender"]).sent.max()
    rows = run.evaluations.assign(receiver=of_vehicle(run, run.evaluations.evaluator))
    foreign = rows[rows.receiver != of_vehicle(run, rows.observer)]
    key = pd.MultiIndex.from_frame(foreign[["step", "receiver", "observer"]])
    assert len(foreign) > 150 and (newest.reindex(key).to_numpy() == foreign.detection_step.to_numpy()).all()
    last = foreign.step - interval_steps(run, foreign.receiver.to_numpy())
    assert (foreign.detection_step > last).all(), "only what is new since the evaluator last sensed"
    reports = pd.DataFrame(messages_used(run, "evaluation"), columns=["step", "receiver", "subject", "sent"])
    looked_up = run.trust_lookups[run.trust_lookups.variant == "base"]
    names = ["step", "receiver", "subject"]
    expected, found = (set(frame[names].itertuples(index=False, name=None)) for frame in (reports, looked_up))
    assert expected == found and len(found) == len(looked_up) > 300


def test_a_detection_is_evaluated_once_by_each(runs):
    for run in runs:
        key = ["evaluator", "detection_step", "observer", "detection_index"]
        assert not run.evaluations.duplicated(key).any()
        named = run.evaluations.merge(
            run.detections, left_on=key[1:], right_on=["step", "observer", "detection_index"], suffixes=("", "_there")
        )
        assert len(named) == len(run.evaluations), "each names a detection"


def test_others_fuse_what_the_messages_contain():
    """A vehicle that senses often looks at a message of one that senses seldom more than once, and sends it once."""
    config = load(None, [*RANDOM, *MIXED])
    n_again = 0
    with Simulation(config) as simulation:
        for now in simulation:
            if now.result.sensed is not None:
                evaluated = now.result.sensed.evaluated
                lists, own, sent = evaluated.of_detections()
                is_sent = ~np.isnan(sent.visibility)
                per_list = np.bincount(lists.of_member()[is_sent], minlength=len(lists.owner))
                assert (per_list == np.diff(evaluated.sent.ptr)).all()
                n_again += (~is_sent & (own.visibility > 0)).sum()
    assert n_again > 100


def test_boxes_of_fused_objects_are_those_of_earlier_messages(runs):
    for run in runs:
        fused = run.fused.merge(
            run.detections, left_on=["source_step", "source", "source_index"],
            right_on=["step", "observer", "detection_index"], suffixes=("", "_there"),
        )  # fmt: skip
        assert len(fused) == len(run.fused) and (fused.length_m == fused.length_m_there).all()
        assert (fused.source_step < fused.step).any()


def test_messages_under_each_pseudonym(tmp_path):
    """Vehicles send when they sense, not in every step in which one of them does."""
    run = open_run(drive(tmp_path / "run", *RANDOM, "traffic.duration_s=14", "pseudonyms.policy=disposable"))
    mean = run.manifest["summary"]["messages_per_pseudonym"]
    assert mean == pytest.approx(len(run.cpm_content) / len(run.pseudonyms), abs=0.01)


@pytest.mark.verify
def test_neither_threads_nor_blocks_change_a_table(runs, tmp_path):
    """`tests/test_determinism.py` says so where all sense together."""
    short = open_run(drive(tmp_path / "blocks", *RANDOM, "record.block_steps=2"))
    assert fingerprint(short.path) == fingerprint(runs[0].path)
    pd.testing.assert_frame_equal(short.fused, runs[0].fused)


def test_extrapolated_boxes_are_moved_by_the_velocity_of_the_message(tmp_path):
    run = open_run(drive(tmp_path / "run", *RANDOM, "traffic.duration_s=3", "extrapolate=true"))
    selves = run.fused[(run.fused.source_index == 0) & (run.fused.source_step < run.fused.step)]
    told = run.detections.set_index(["step", "observer", "detection_index"])
    told = told.loc[pd.MultiIndex.from_frame(selves[["source_step", "source", "source_index"]])]
    away_m = told.speed_mps.to_numpy(float) * 0.2 * (selves.step - selves.source_step).to_numpy()
    yaw = told.yaw_rad.to_numpy(float)
    for axis, along in (("x_m", np.cos(yaw)), ("y_m", np.sin(yaw))):
        moved = (selves[axis].to_numpy() - told[axis].to_numpy()).astype(float)
        np.testing.assert_allclose(moved, away_m * along, atol=0.02)  # stored in steps of 2^-7 m
    assert len(selves) > 100 and np.abs(away_m).max() > 3


@pytest.mark.parametrize("wrong, says", [
    (["sensing_phase=random"], r"as long as the sensing interval.* a fraction of it, such as 0\.5, or sensing_phase"),
    (["sensing_phase=random", "traffic.step_s=0.1", "sensing_interval_s=0.1"], r"such as 0\.05"),
    (["sensing_phase=late"], "sensing_phase"),
    (["sensing_groups=[{share_p=0.7,interval_s=1},{share_p=0.6,interval_s=2}]"], "add up to 1.3"),
    (["sensing_groups=[{share_p=0.7,interval_s=1.5}]"], r"sensing_groups.0.interval_s = 1.5 s is not a multiple"),
    (["traffic.step_s=0.2", "sensing_phase=random", "radio.timeout_s=0.6"], "1 s apart"),
])  # fmt: skip
def test_mistakes_are_one_line(wrong, says):
    with refused_in_one_line(says):
        load(None, wrong)


def test_schedule_of_names():
    """Intervals by share, phases below the interval; renaming others changes nothing."""
    names = np.random.default_rng(1).integers(0, 2**63, 20000).astype(np.uint64)
    groups = (SensingGroup(share_p=0.3, interval_s=0.5), SensingGroup(share_p=0.2, interval_s=0.1))
    schedule = Schedule.of(1.0, "random", groups, 0.1, 5)
    interval, phase = schedule.of_vehicles(names)
    for steps, share in ((5, 0.3), (1, 0.2), (10, 0.5)):
        mine = interval == steps
        assert abs(mine.mean() - share) < 3 * np.sqrt(share * (1 - share) / len(names))
        counts = np.bincount(phase[mine], minlength=steps)
        assert len(counts) == steps and np.abs(counts / mine.sum() - 1 / steps).max() < 0.02
    some = schedule.of_vehicles(names[::7])
    assert (some[0] == interval[::7]).all() and (some[1] == phase[::7]).all()
    common = Schedule.of(1.0, "common", groups, 0.1, 5)
    assert common.exchange_every_steps == 1 and not common.of_vehicles(names)[1].any()
    assert Schedule.of(1.0, "common", (), 0.5, 5).is_lock_step


def test_pairs_between_are_the_overlaps_of_two_sets():
    rng = np.random.default_rng(3)
    boxes, label = random_boxes(rng, 300)
    i, j, iou = overlapping_pairs(boxes, label, np.arange(300))
    cut = (i < 120) & (j >= 120)
    a, b = boxes.take(slice(0, 120)), boxes.take(slice(120, None))
    got = pairs_between(a, label[:120], b, label[120:])
    assert cut.sum() > 20
    for found, expected in zip(got, (i[cut], j[cut] - 120, iou[cut]), strict=True):
        np.testing.assert_array_equal(found, expected)
    nothing = Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert not len(pairs_between(a, label[:120], nothing, label[:0])[0])
