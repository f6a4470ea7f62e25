"""The trackers' tables of a driven run, derived again from `actors` and `receptions` in plain loops.

Range is a matter of distance alone. The medium is the unit disk, in which every vehicle sends in both rounds, unless a
test says otherwise.
"""

from collections import Counter

import numpy as np
import pytest

from results.archive import open_run
from tests.drive import drive

RANGE_M = 150.0


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    changes = ("radio.model=unit_disk", "radio.unit_disk.loss_p=0.3", f"radio.range_m={RANGE_M}", "record.level=full")
    return open_run(drive(tmp_path_factory.mktemp("run") / "unit_disk", *changes, "traffic.duration_s=12"))


@pytest.fixture(scope="module")
def distance_m(run):
    return distances_m(run)


def distances_m(run):
    """By step: ordered pairs of equipped vehicles and their distance."""
    equipped = set(run.vehicles.vehicle[run.vehicles.equipped])
    steps = {}
    for step, now in run.actors.groupby("step"):
        at = {a: (x, y) for a, x, y in zip(now.actor, now.x_m, now.y_m, strict=True) if a in equipped}
        steps[step] = {(a, b): float(np.hypot(*np.subtract(at[a], at[b]))) for a in at for b in at if a != b}
    return steps


def received(run, message_type):
    """By step, the pairs (sender, receiver) of the messages received."""
    rows = run.receptions[run.receptions.message_type == message_type]
    return {step: set(zip(now.sender, now.receiver, strict=True)) for step, now in rows.groupby("step")}


def test_vehicle_channel(run, distance_m):
    n_received = run.receptions.groupby(["step", "receiver"]).size()
    assert len(run.vehicle_channel)
    for row in run.vehicle_channel.itertuples():
        in_range = sum(d <= RANGE_M for (_, b), d in distance_m[row.step].items() if b == row.vehicle)
        assert row.n_in_range == 2 * in_range
        assert row.n_received == n_received.get((row.step, row.vehicle), 0)


def test_pdr_by_distance(run, distance_m):
    tried, delivered = Counter(), Counter()
    for message_type in ("cpm", "evaluation"):
        got = received(run, message_type)
        for step, pairs in distance_m.items():
            for pair, d in pairs.items():
                if d <= RANGE_M:
                    tried[message_type, int(d) // 25 * 25] += 1
                    delivered[message_type, int(d) // 25 * 25] += pair in got.get(step, ())
    found = run.pdr_by_distance.groupby(["message_type", "distance_bin_m"], observed=True)
    assert found.n_in_range.sum().to_dict() == dict(tried)
    assert found.n_delivered.sum().to_dict() == dict(delivered)


@pytest.mark.parametrize("message_type", ["cpm", "evaluation"])
def test_packet_inter_reception(run, distance_m, message_type):
    got, last, counts = received(run, message_type), {}, Counter()
    for step, pairs in distance_m.items():
        in_range = {pair for pair, d in pairs.items() if d <= RANGE_M}
        for pair in list(last):
            if pair not in in_range:
                counts[step, step - 1 - last.pop(pair), "n_censored"] += 1
        for pair in in_range & got.get(step, set()):
            if pair in last:
                counts[step, step - last[pair], "n_received"] += 1
            last[pair] = step
    rows = run.packet_inter_reception[run.packet_inter_reception.message_type == message_type]
    found = {
        (row.step, row.pir_steps, name): getattr(row, name)
        for row in rows.itertuples() for name in ("n_received", "n_censored") if getattr(row, name)
    }  # fmt: skip
    assert found == dict(counts) and len(found) > 20


def test_vehicles_without_a_message_end_no_interval(tmp_path):
    """With generation rules vehicles send every five sweeps, and nothing is lost: all intervals last 0.5 s."""
    rules = ("cpm.rules=etsi", "cpm.interval_s=0.5", "sensing_interval_s=0.1", "sensing_phase=common")
    unit_disk = ("radio.model=unit_disk", "radio.unit_disk.loss_p=0", "traffic.step_s=0.1", "traffic.duration_s=2.5")
    run = open_run(drive(tmp_path / "etsi", *unit_disk, *rules, "record.level=full"))
    got = run.receptions[run.receptions.message_type == "cpm"].sort_values("step")
    since = got.groupby(["sender", "receiver"]).step.diff().dropna()
    rows = run.packet_inter_reception[run.packet_inter_reception.message_type == "cpm"]
    ended = rows.groupby("pir_steps").n_received.sum()
    assert ended[ended > 0].to_dict() == since.value_counts().to_dict() and len(since) > 20


def test_messages_forwarded_beyond_range_do_not_count(tmp_path):
    """Forwarded messages reach vehicles within range and beyond it, many of them in later steps.

    What counts is whether two vehicles were within range when the message was made, or when it went from one to the
    other without a hop between.
    """
    phases = ("traffic.step_s=0.2", "sensing_phase=random", "traffic.duration_s=4", "fleet.penetration_p=1")
    relay = ("radio.relay.max_hops=3", f"radio.range_m={RANGE_M}", "record.level=full")
    run = open_run(drive(tmp_path / "relay", *phases, *relay))
    got = run.receptions[run.receptions.message_type == "cpm"]
    columns = ["sender", "receiver", "message_step", "hops"]
    messages = {step: now[columns].to_numpy().tolist() for step, now in got.groupby("step")}
    within: dict[int, set] = {}  # by step, the pairs within range whose sender has a message
    near, last, counts, n_beyond = set(), {}, Counter(), 0
    for step, pairs in distances_m(run).items():
        sends = set(run.cpm_content[run.cpm_content.step == step].sender)
        within[step] = {pair for pair, d in pairs.items() if d <= RANGE_M and pair[0] in sends}
        arrived = {(a, b) for a, b, made, hops in messages.get(step, ()) if hops == 1 or (a, b) in within[made]}
        n_beyond += len(messages.get(step, ())) - len(arrived)
        near = within[step] | arrived | {pair for pair in near if pair[0] not in sends}
        counts.update(step - last[pair] for pair in arrived & last.keys())
        last = {pair: at for pair, at in last.items() if pair in near} | dict.fromkeys(arrived, step)
    rows = run.packet_inter_reception[run.packet_inter_reception.message_type == "cpm"]
    ended = rows.groupby("pir_steps").n_received.sum()
    assert ended[ended > 0].to_dict() == dict(counts) and len(counts) > 2 and n_beyond > 100
    assert (got.message_step < got.step).sum() > 20


def test_encounters(run, distance_m):
    """Start, end and smallest distance of every encounter of equipped vehicles; breaks below 3 s are bridged."""
    steps, n_steps, expected = distance_m, run.manifest["steps"], set()
    for pair in {pair for pairs in steps.values() for pair in pairs if pair[0] < pair[1]}:
        stretch: list[int] = []
        for step in range(n_steps + 1):
            near = step < n_steps and steps[step].get(pair, np.inf) <= 100
            gone = step < n_steps and pair not in steps[step]
            if stretch and (step == n_steps or gone or (not near and step - stretch[-1] >= 3)):
                expected.add((*pair, stretch[0], stretch[-1] + 1, round(min(steps[s][pair] for s in stretch), 1)))
                stretch = []
            if near:
                stretch.append(step)
    found = run.encounters
    rows = zip(found.a, found.b, found.start_step, found.end_step, found.min_distance_m, strict=True)
    assert {(a, b, start, end) for a, b, start, end, _ in expected} == {tuple(map(int, row[:4])) for row in rows}
    near_m = {row[:4]: row[4] for row in expected}
    for row in found.itertuples():
        assert row.min_distance_m == pytest.approx(near_m[row.a, row.b, row.start_step, row.end_step], abs=0.06)
