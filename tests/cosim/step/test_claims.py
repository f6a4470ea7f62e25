"""Which messages raise which questions, against literal loops; and what the answers do to liars and others."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.config.config import resolve_data
from cosim.messages.content import SELF, SENSED, velocities
from cosim.step.claims import claims_of
from cosim.step.parts import check_choices
from sensors.tracking.motion import confirmed_variance
from sensors.tracking.params import TrackingParams
from sensors.tracking.tracks import ObjectStates
from tests.cosim.attacks.plain import play
from tests.refusals import refused_in_one_line
from tests.sensors.town import boxes_at
from tests.slow import slow
from trust.claims import MISSING, SPEED, velocity_support
from trust.params import KINDS
from trust.tables import Groups, ObjectLists

EVIDENCE = {"evidence": ["detections", "missing", "speed"]}
TRACKS = {"model": "constant_velocity"}


STEP_S = 0.2
INTERVALS = 5, 10
"""Steps between two sweeps of vehicles with even and with odd numbers."""


class Scene:
    """Messages with random content in random lists, as the stages of a step hand them over.

    The last three are of earlier steps. Of those, the first is not new to the first vehicle.
    """

    def __init__(self, seed, n_vehicles=4, max_objects=4, extrapolate=True):
        rng = np.random.default_rng(seed)
        self.max_objects, self.extrapolate, n = max_objects, extrapolate, n_vehicles
        size = rng.integers(1, 7, n + 3)
        message = np.repeat(np.arange(n + 3), size)
        index = np.arange(len(message)) - np.searchsorted(message, message)
        is_self, d = index == 0, len(message)
        boxes = boxes_at(np.column_stack([rng.uniform(0, 25, (d, 2)), np.zeros(d)]), (4.0, 2, 2))
        speed = np.where(is_self, rng.uniform(0, 20, d), np.nan)
        velocity = np.where((~is_self & (rng.random(d) < 0.7))[:, None], rng.normal(0, 5, (d, 2)), np.nan)
        objects = SimpleNamespace(
            boxes=boxes, transmitted=is_self | (rng.random(d) < 0.8), speed_mps=speed, velocity_mps=velocity,
            origin=np.where(is_self, SELF, SENSED),
        )  # fmt: skip
        detections = SimpleNamespace(
            message=message, detection_index=index, label=rng.integers(0, 4, d).astype(np.uint8),
            score=np.where(is_self, 1.0, rng.random(d)), is_self=is_self,
        )  # fmt: skip
        vehicle = np.append(np.arange(n), [1, n, n + 1])
        step, since = np.append(np.full(n, 7), [3, 4, 6]), np.append(4, np.full(n - 1, 3))
        self.messages = SimpleNamespace(
            objects=objects, detections=detections, ptr=np.append(0, np.cumsum(size)), vehicle=vehicle, step=step,
            velocity_mps=velocities(objects),
            detection_step=lambda d: step[message[d]], is_new=lambda v, d: step[message[d]] >= since[v],
        )  # fmt: skip
        self.since = since
        self.exchange = SimpleNamespace(
            now=SimpleNamespace(step=7),
            vehicles=SimpleNamespace(senses=np.arange(n), name_key=np.arange(n + 2)),
            sensing=SimpleNamespace(row=np.arange(n)),
            world=SimpleNamespace(boxes=boxes_at(np.zeros((n, 3)), yaw_rad=rng.uniform(-3, 3, n)),
                                  speed_mps=rng.uniform(0, 20, n)),
        )  # fmt: skip
        lists, seeds, mine = [], [], []
        for v in range(n):
            foreign = np.flatnonzero((message != v) & objects.transmitted & (rng.random(d) < 0.8))
            members = np.concatenate([np.flatnonzero(message == v), foreign])
            at = sum(map(len, lists))
            seed = np.arange(len(members))
            for k in range(size[v], len(members)):
                if rng.random() < 0.6:
                    seed[k] = seed[rng.integers(0, k)]
            lists.append(members)
            seeds.append(at + seed)
            mine.append(seed < size[v])
        ptr = np.append(0, np.cumsum([len(one) for one in lists]))
        self.matched = SimpleNamespace(
            lists=ObjectLists(ptr, np.concatenate(lists), np.arange(n)),
            groups=Groups(np.concatenate(seeds), np.concatenate(mine)),
        )  # fmt: skip
        s = int((objects.origin == SENSED).sum())
        angle = rng.uniform(-3, 3, s)
        self.states = ObjectStates(
            object_id=np.arange(s), age_s=np.zeros(s), existence_p=np.ones(s),
            velocity_mps=np.where(rng.random((s, 1)) < 0.8, rng.normal(0, 5, (s, 2)), np.nan),
            axis=np.column_stack([np.cos(angle), np.sin(angle)]), variance=rng.uniform(0.02, 2, (s, 2)),
        )  # fmt: skip

    def parts(self, *evidence):
        """Parts of a run in which every body has the recall of its row, in hundredths."""
        recall = SimpleNamespace(expected_recall=lambda carrier, near, boxes, label: (near.row % 100) / 100)
        config = SimpleNamespace(
            trust=SimpleNamespace(evidence=("detections", *evidence)),
            cpm=SimpleNamespace(max_objects=self.max_objects),
            tracking=TrackingParams(model="constant_velocity"),
            traffic=SimpleNamespace(step_s=STEP_S),
            extrapolate=self.extrapolate,
        )
        schedule = SimpleNamespace(of_vehicles=lambda key: (np.array(INTERVALS)[key % 2], None))
        return SimpleNamespace(coverage=recall, config=config, schedule=schedule)

    def claims(self, *evidence):
        """(list, member, number) of every claim, with its support."""
        found = claims_of(self.exchange, self.messages, self.matched, self.states, self.parts(*evidence))
        keys = list(zip(found.list.tolist(), found.member.tolist(), found.number.tolist(), strict=True))
        assert keys == sorted(keys)
        return dict(zip(keys, found.support.tolist(), strict=True))

    def velocity_mps(self, k):
        """Velocity that a detection claims, or NaN. Self reports of the scene face east."""
        o = self.messages.objects
        return o.velocity_mps[k] if not self.messages.detections.is_self[k] else o.speed_mps[k] * np.array([1.0, 0.0])

    def xy_m(self, k, step):
        """Where the object of a detection was in a step, as far as the detection claims a velocity."""
        of = 7 if self.extrapolate else self.messages.step[self.messages.detections.message[k]]
        return self.messages.objects.boxes.xyz_m[k, :2] + (step - of) * STEP_S * np.nan_to_num(self.velocity_mps(k))

    def in_lists(self):
        """List, position and member of every member of the lists."""
        ptr, member = self.matched.lists.ptr, self.matched.lists.member
        return [(v, p, member[p]) for v in range(len(ptr) - 1) for p in range(ptr[v], ptr[v + 1])]


def confirmed_after():
    """Variances of velocities by the interval of the vehicle that tracks: even, odd."""
    return [confirmed_variance(TrackingParams(), n * STEP_S) for n in INTERVALS]


@pytest.mark.parametrize("seed", range(25))
def test_missing_objects_against_literal_loops(seed):
    scene = Scene(seed, extrapolate=seed % 2 == 0)
    p, confirmed = TrackingParams(), confirmed_after()
    m, d, o = scene.messages, scene.messages.detections, scene.messages.objects
    member, seed_of = scene.matched.lists.member, scene.matched.groups.seed
    expected = {}
    for v, at, own in scene.in_lists():
        sender = d.message[own]
        inside = [k for k in range(m.ptr[sender], m.ptr[sender + 1]) if o.transmitted[k] and not d.is_self[k]]
        is_asked = m.vehicle[sender] != v and m.step[sender] >= scene.since[v] and len(inside) < scene.max_objects
        if not d.is_self[own] or not is_asked:
            continue
        step = m.step[sender]
        age_s = (7 - step) * STEP_S
        for w, q, body in scene.in_lists():
            is_seed_of_own = w == v and seed_of[q] == q and d.message[body] == v
            if not is_seed_of_own or seed_of[at] == q or body % 100 == 0:
                continue  # of another list, not the evaluator's, the sender itself, or not to be expected
            label, interval = d.label[body], m.vehicle[d.message[body]] % 2
            variance = confirmed[interval][label, 0]
            if np.isnan(scene.velocity_mps(body)).any():
                variance = p.along_mean_mps[label] ** 2 + p.along_sigma_mps[label] ** 2
            if np.sqrt(variance * age_s**2 + p.acceleration_noise[label] * age_s**3 / 3) > 1.0:
                continue  # where it was is not known
            a = d.score[body] * (body % 100) / 100
            near = any(np.hypot(*(scene.xy_m(k, step) - scene.xy_m(body, step))) <= 4.0 for k in inside)
            number = d.detection_index[body] * len(KINDS) + MISSING
            expected[v, own, number] = 1 / 3 if near else -a / (4 - 3 * a)
    found = scene.claims("missing")
    assert found.keys() == expected.keys() and len(member)
    assert all(found[key] == pytest.approx(expected[key], abs=1e-12) for key in found)


@pytest.mark.parametrize("seed", range(25))
def test_velocities_against_literal_loops(seed):
    scene = Scene(seed)
    m, d, o, states = scene.messages, scene.messages.detections, scene.messages.objects, scene.states
    member, groups = scene.matched.lists.member, scene.matched.groups
    p, confirmed = TrackingParams(), confirmed_after()
    expected = {}
    for v, at, claim in scene.in_lists():
        sender, own = d.message[claim], member[groups.seed[at]]
        if d.message[own] != v or m.vehicle[sender] == v or m.step[sender] < scene.since[v]:
            continue
        if not d.is_self[d.message == sender].any():  # it could only be denied
            continue
        said = scene.velocity_mps(claim)
        if d.is_self[own]:  # the evaluator's own speed, along its heading
            yaw = scene.exchange.world.boxes.yaw_rad[v]
            axis, variance = np.array([np.cos(yaw), np.sin(yaw)]), np.full(2, 0.01)
            known = scene.exchange.world.speed_mps[v] * axis
        else:
            k = sum(o.origin[:own] == SENSED)
            known, axis, variance = states.velocity_mps[k], states.axis[k], states.variance[k]
        if np.isnan(said).any() or np.isnan(known).any():
            continue
        label, (x, y), (c, s) = d.label[own], said - known, axis
        variance = variance + (0.0 if d.is_self[claim] else confirmed[m.vehicle[sender] % 2][label])
        variance = variance + p.acceleration_noise[label] * (7 - m.step[sender]) * STEP_S
        prior = [p.along_sigma_mps[label] ** 2, p.across_sigma_mps[label] ** 2]
        apart = np.array([[c * x + s * y, c * y - s * x]])
        support = velocity_support(apart, variance[None], np.array([prior]))[0]
        if d.is_self[claim] or support < 0:  # right velocities of other objects are no evidence
            expected[v, claim, d.detection_index[claim] * len(KINDS) + SPEED] = support
    found = scene.claims("speed")
    assert found.keys() == expected.keys()
    assert all(found[key] == pytest.approx(expected[key], abs=1e-9) for key in found)


def of_kind(tables, kind, n_before=0):
    """Evaluations of a kind by others, with the role of the sender: evaluation times visibility."""
    rows = tables["evaluations"]
    rows = rows[(rows.kind == kind) & (rows.evaluator != rows.observer) & (rows["at"] >= n_before)]
    return rows.assign(support=rows.evaluation * rows.visibility)


def test_who_withholds_all_loses_and_the_honest_win():
    tables = play([{"attack": "removal", "share_p": 0.25}], n_steps=2, trust=EVIDENCE, tracking=TRACKS)
    rows = of_kind(tables, MISSING)
    attacks = rows.observer.isin(np.flatnonzero(tables.registry.attack > 0))
    assert rows.support[attacks].max() < 0 and attacks.sum() > 20
    honest = rows.support[~attacks]
    assert honest.mean() > 0.1 and (honest > 0).mean() > 0.75
    seen = tables["evaluations"][tables["evaluations"].kind == 0]
    assert len(seen) > len(rows) and (tables["evaluations"].lied == 0).all()


def test_false_speeds_are_found_once_there_are_tracks():
    tables = play([{"attack": "speed", "share_p": 0.25, "min_mps": 4.0}], n_steps=6, trust=EVIDENCE, tracking=TRACKS)
    rows = of_kind(tables, SPEED, 4)
    rows = rows[rows.detection_index == 0]
    attacks = rows.observer.isin(np.flatnonzero(tables.registry.attack > 0))
    assert attacks.sum() > 10 and rows.support[attacks].max() < 0 and (rows.support[~attacks] > 0).mean() > 0.95


def test_who_does_not_report_itself_is_not_denied_for_speeds():
    tables = play([], n_steps=6, trust={"evidence": ["detections", "speed"], "self_reports": False}, tracking=TRACKS)
    assert len(tables["evaluations"]) > 100 and not (tables["evaluations"].kind == SPEED).any()


IN_TURNS = {"traffic": {"step_s": STEP_S}, "sensing_phase": "random", "extrapolate": True}
"""One vehicle in five senses in each step."""


def messages_of(rows):
    """Step, evaluator, sender, and step of the message of every evaluation by others, each once."""
    keys = ["at", "evaluator", "observer", "detection_step"]
    return set(rows[rows.evaluator != rows.observer][keys].itertuples(index=False, name=None))


@cache
def evaluations(in_turns):
    """Of thirty steps in which vehicles sense in turns, or all in each."""
    world = IN_TURNS if in_turns else {}
    return play(n_steps=30, trust=EVIDENCE, tracking=TRACKS, **world)["evaluations"]


@pytest.mark.parametrize(("in_turns", "ages"), [(True, {0, 1, 2, 3, 4}), slow(False, {0})])
def test_each_message_is_asked_about_once(in_turns, ages):
    """In the step in which its evaluator evaluates the sender's self report, whatever the phases of the two."""
    rows = evaluations(in_turns)
    assert not rows.duplicated(["evaluator", "observer", "detection_step", "detection_index", "kind"]).any()
    reports = messages_of(rows[(rows.kind == 0) & (rows.detection_index == 0)])
    rows = rows[rows["at"] >= 15]  # from here on, vehicles have tracks
    for kind, least_p in ((MISSING, 0.4), (SPEED, 0.35)):  # of the others, nothing is known
        asked = messages_of(rows[(rows.kind == kind) & ((rows.detection_index == 0) | (kind == MISSING))])
        assert asked <= reports
        for age in ages:
            n, of = (sum(at - step == age for at, _, _, step in some if at >= 15) for some in (asked, reports))
            assert n > least_p * of > 20
    assert {at - step for at, _, _, step in reports} == ages


def test_who_senses_at_another_time_is_no_liar():
    """Vehicles drive 8 m in the longest time between two sweeps: more than the tolerance of 4 m."""
    rows = evaluations(in_turns=True)
    rows = rows[(rows.evaluator != rows.observer) & (rows["at"] >= 15)]
    rows = rows.assign(support=rows.evaluation * rows.visibility, is_late=rows["at"] > rows.detection_step)
    missing = rows[rows.kind == MISSING].groupby("is_late").support.mean()
    assert missing[True] > 0.9 * missing[False] > 0.15
    speeds = rows[(rows.kind == SPEED) & (rows.detection_index == 0)].groupby("is_late").support
    assert (speeds.mean() > 0.5).all() and speeds.agg(lambda one: (one < 0).mean()).max() < 0.02


def test_bad_mouthing_denies_every_kind():
    tables = play([{"attack": "bad_mouthing", "share_p": 0.25}], n_steps=4, trust=EVIDENCE, tracking=TRACKS)
    rows = tables["evaluations"]
    lies = rows[rows.evaluator.isin(np.flatnonzero(tables.registry.attack > 0)) & (rows.evaluator != rows.observer)]
    assert set(lies.kind) == {0, MISSING, SPEED} and (lies.lied == 1).mean() > 0.3


def test_other_evaluations_are_the_same_without_claims():
    """Claims add rows. What is fused and what is said about detections do not change."""
    with_claims, without = (play(n_steps=3, tracking=TRACKS, trust=trust) for trust in (EVIDENCE, {}))
    rows = with_claims["evaluations"]
    assert "kind" not in without["evaluations"] and set(rows.kind) == {0, MISSING, SPEED}
    same = rows[rows.kind == 0].drop(columns="kind").reset_index(drop=True)
    assert same.astype(float).equals(without["evaluations"].astype(float))
    assert with_claims["evidence"].equals(without["evidence"])
    keys = ["at", "evaluator", "observer", "detection_index", "kind"]
    assert not rows.duplicated(keys).any() and len(with_claims["transmitted_evaluations"][keys].drop_duplicates())


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        ({}, 'names "speed", but vehicles do not track'),
        ({"tracking": TRACKS, "trust": {**EVIDENCE, "self_reports": False}}, "trust.self_reports = false"),
        ({"tracking": TRACKS, "cpm": {"rules": "etsi"}}, 'cpm.rules = "etsi" leaves objects out'),
        ({"tracking": TRACKS, "cpm": {"redundancy": "distance"}}, 'cpm.redundancy = "distance" leaves objects out'),
        ({"tracking": TRACKS, "detector": {"model": "tests.parts:MixedActors"}}, "has no method recall"),
    ],
)
def test_what_is_refused_at_the_door(sections, reason):
    with refused_in_one_line(reason):
        check_choices(resolve_data({"trust": EVIDENCE} | sections, "a test", None))
