"""Every attack does what it says: counted in the tables, with ground truth, beside the same steps without it."""

import numpy as np
import pandas as pd
import pytest

from cosim.attacks.catalogue import ATTACKS
from cosim.base.codes import Origin
from results.archive import open_run
from tests.cosim.attacks.plain import NAMES, N, play
from tests.drive import drive

LIARS = ["v00", "v07", "v15", "v23"]
WHO = np.array([NAMES.index(name) for name in LIARS])
BY = {"ids": LIARS}
KEY = ["at", "observer", "detection_index"]
FABRICATED, SELF = int(Origin.FABRICATED), int(Origin.SELF)


def attacked(attack, keys=(), **world):
    """Tables of some steps in which the liars carry out this attack."""
    return play([BY | {"attack": attack} | dict(keys)], **world)


@pytest.fixture(scope="module")
def honest():
    return play()


@pytest.fixture(scope="module")
def honest_in_turns():
    return play(n_steps=30, **IN_TURNS)


def beside(tables, honest, name="detections", key=None):
    """Rows that are in both, the honest columns with the suffix _was."""
    return tables[name].merge(honest[name], on=key or KEY, suffixes=("", "_was"))


def of_liars(tables, honest):
    """What the attackers sensed, with the honest columns beside."""
    rows = beside(tables, honest)
    return rows[rows.observer.isin(WHO) & (rows.origin == 0)]


def lies_of(tables, only=WHO):
    found = tables["detections"]
    assert set(found.observer[found.lied]) <= set(only)
    return found[found.lied]


def assert_others_untouched(tables, honest):
    """Rows of honest vehicles are those of the run without the attack."""
    a, b = (t["detections"] for t in (tables, honest))
    a, b = (f[~f.observer.isin(WHO)].reset_index(drop=True) for f in (a, b))
    pd.testing.assert_frame_equal(a, b)


def test_approaching_ghost(honest):
    """60 m ahead of the nearest neighbour, 5 m nearer in every message."""
    tables = attacked("approaching_ghost")
    ghosts = lies_of(tables)
    assert len(ghosts) == 6 * len(LIARS) and (ghosts.origin == FABRICATED).all()
    world = tables["actors"].merge(ghosts, on="at", suffixes=("", "_ghost"))
    ahead = (world.x_m_ghost - world.x_m)[(world.y_m - world.y_m_ghost).abs() < 1e-6]
    for number in range(6):
        assert np.isclose(ahead[world["at"] == number], 60.0 - 5.0 * number).any()
    assert_others_untouched(tables, honest)


def test_approaching_ghost_comes_as_near_as_it_should():
    """Three times 0.1 m from 60.3 m on are 60 m, in the fourth message; 0.3 / 0.1 is 2.99."""
    tables = attacked("approaching_ghost", {"from_m": 60.3, "to_m": 60.0, "step_m": 0.1}, n_steps=4)
    world = tables["actors"].merge(lies_of(tables), on="at", suffixes=("", "_ghost"))
    for number, ahead_m in enumerate((60.3, 60.2, 60.1, 60.0)):
        assert np.isclose(world.x_m_ghost - world.x_m, ahead_m, atol=1e-5)[world["at"] == number].any()


@pytest.mark.parametrize("more", [{}, {"left_m": -2.0, "ahead_m": 9.0}])
def test_trust_flip(honest, more):
    """The nearest neighbour of each attacker detects a car before it; nobody lies, and nothing else changes."""
    tables = attacked("trust_flip", more)
    rows = tables["detections"]
    is_phantom = (rows.origin == 0) & rows.target.notna()
    found = rows[is_phantom]
    victims = set(found.observer)
    assert len(victims) == len(LIARS) and not victims & set(WHO)
    assert (found.target == found.observer).all()
    assert (found.groupby("observer").size() == 6).all() and (found["class"] == 0).all()
    assert found.truth_actor.isna().all() and found.transmitted.all() and not rows.lied.any()
    world = tables["actors"].merge(found, left_on=["at", "actor"], right_on=["at", "observer"], suffixes=("", "_seen"))
    np.testing.assert_allclose(world.x_m_seen - world.x_m, more.get("ahead_m", 8.0), atol=1e-5)
    np.testing.assert_allclose(world.y_m_seen - world.y_m, more.get("left_m", 0.0), atol=1e-5)
    real = rows[~is_phantom].reset_index(drop=True)  # numbered with the phantoms among them
    number = real.groupby(["at", "observer"]).cumcount().astype(real.detection_index.dtype)
    pd.testing.assert_frame_equal(real.assign(detection_index=number), honest["detections"])
    made = tables["evaluations"].merge(found[KEY], on=KEY)
    own = made.evaluator == made.observer
    assert (made.evaluation[own] > 0).all() and own.sum() == len(found)
    denied = made[~own & (made.visibility > 0)]
    assert len(denied) > 50 and (denied.evaluation < 0).mean() > 0.9
    assert not tables["evaluations"].lied.any()
    assert tables.state.attack_start.step_of == dict.fromkeys(WHO.tolist(), 0)


def test_trust_flip_misleads_by_chance_and_once_per_victim():
    """Two attackers of one victim make one phantom, and a detector that is never misled reports none."""
    one = {"victim": "one", "victim_id": "v12", "victim_range_m": 60.0}
    for misled_p, expected in ((1.0, 3), (0.0, 0)):
        rows = attacked("trust_flip", one | {"misled_p": misled_p}, n_steps=3)["detections"]
        assert ((rows.origin == 0) & rows.target.notna()).sum() == expected


def test_trust_flip_takes_the_nearest_free_place():
    """The next car is 17 m ahead: 9 m from a place at 8 m, 3 m from one at 14 m, 7 m from one at 24 m."""
    one = {"victim": "one", "victim_id": "v12", "victim_range_m": 60.0}
    for more, ahead_m in (({}, [8.0]), ({"ahead_m": 14.0}, [24.0]), ({"ahead_m": 14.0, "farthest_m": 23.5}, [])):
        tables = attacked("trust_flip", one | more, n_steps=1)
        rows = tables["detections"]
        found = rows[(rows.origin == 0) & rows.target.notna()]
        x_m = tables["actors"].set_index("actor").x_m[12]
        assert (found.x_m - x_m).tolist() == pytest.approx(ahead_m, abs=1e-5)
    with pytest.raises(ValueError, match=r"attacks.farthest_m = 5 m is below attacks.ahead_m = 8 m. Swap them."):
        attacked("trust_flip", one | {"farthest_m": 5.0}, n_steps=1)


def test_removal(honest):
    tables = attacked("removal")
    rows = beside(tables, honest)
    own = rows.observer.isin(WHO) & (rows.origin != SELF)
    assert own.sum() > 50 and not rows.transmitted[own].any() and rows.transmitted[~own].all()
    assert (rows.lied == own).all()


def test_removal_of_the_victim_alone(honest):
    tables = attacked("removal", {"only_victim": True, "victim": "random"})
    hidden = tables["detections"][~tables["detections"].transmitted]
    assert 0 < len(hidden) and hidden.groupby(["at", "observer"]).truth_actor.nunique().max() == 1
    assert (hidden.truth_iou > 0).all() and hidden.lied.all()


@pytest.mark.parametrize("offset", ["constant", "random"])
def test_offset(honest, offset):
    tables = attacked("offset", {"offset": offset})
    own = of_liars(tables, honest)
    east, north = own.x_m - own.x_m_was, own.y_m - own.y_m_was
    for shift in (east.abs(), north.abs()):
        assert shift.between(20 - 1e-6, 70 + 1e-6).all()
    n_shifts = pd.DataFrame({"who": own.observer, "e": east.round(6)}).drop_duplicates().shape[0]
    assert n_shifts == len(LIARS) if offset == "constant" else n_shifts > 0.9 * len(own)
    assert own.lied.all() and len(lies_of(tables)) == len(own)
    assert_others_untouched(tables, honest)


def test_drift(honest):
    """2 m/s for steps 0, 1, 2, ...: 0, 2, 4, then 5 m at most."""
    tables = attacked("drift", {"speed_mps": 2.0, "max_m": 5.0})
    own = of_liars(tables, honest)
    away = np.hypot(own.x_m - own.x_m_was, own.y_m - own.y_m_was)
    np.testing.assert_allclose(away, np.minimum(2.0 * own["at"], 5.0), atol=1e-9)
    assert (own.lied == (own["at"] > 0)).all()


def test_mirror(honest):
    tables = attacked("mirror")
    own = of_liars(tables, honest)
    lane = 4.0 * (own.observer // 10)  # all head east
    np.testing.assert_allclose(own.y_m - lane, -(own.y_m_was - lane), atol=1e-9)
    np.testing.assert_allclose(own.x_m, own.x_m_was, atol=1e-9)
    np.testing.assert_allclose(np.sin(own.yaw_rad), -np.sin(own.yaw_rad_was), atol=1e-9)


@pytest.mark.parametrize(("attack", "keys", "column", "made"), [
    ("heading", {"turn_deg": 30.0}, "yaw_rad", lambda r: np.angle(np.exp(1j * (r.yaw_rad_was + np.pi / 6)))),
    ("size", {"factor": 1.5}, "length_m", lambda r: 1.5 * r.length_m_was),
    ("score", {"claimed": 0.05}, "score", lambda r: np.full(len(r), 0.05)),
    ("classification", {}, "class", lambda r: np.where(r["class_was"] == 0, 1, 0)),
])  # fmt: skip
def test_one_falsified_column(honest, attack, keys, column, made):
    tables = attacked(attack, keys)
    own = of_liars(tables, honest)
    np.testing.assert_allclose(own[column], made(own), atol=1e-9)
    changed = (own.score - own.score_was).abs() > 0.1 if attack == "score" else np.full(len(own), True)
    assert (own.lied == changed).all() and len(lies_of(tables)) == changed.sum() > 50
    assert_others_untouched(tables, honest)


def test_replay(honest):
    """Every fabricated box is one that another vehicle sent at most 5 s before."""
    tables = attacked("replay", {"n_objects": 4, "age_s": 3.0})
    lies = lies_of(tables)
    assert 1 <= lies.groupby(["at", "observer"]).size().min() and lies.groupby(["at", "observer"]).size().max() <= 4
    true = honest["detections"][["at", "observer", "x_m", "y_m", "score"]]
    found = lies.merge(true, on=["x_m", "y_m", "score"], suffixes=("", "_made"))
    assert set(found.index) and found.groupby(KEY).ngroups == len(lies)
    age = found["at"] - found.at_made
    assert age.between(1, 3).all() and (found.observer != found.observer_made).all()


def test_replay_of_vehicles_that_send_at_other_times(honest_in_turns):
    """Random phases in steps of 0.2 s: of each sender the oldest message within 1.5 s, so that all have a message."""
    honest = honest_in_turns["detections"]
    keys = {"n_objects": 200, "age_s": 1.5}
    lies = lies_of(attacked("replay", keys, n_steps=30, **IN_TURNS))
    true = honest[["at", "observer", "x_m", "y_m", "score"]]
    found = lies[lies["at"] > 15].merge(true, on=["x_m", "y_m", "score"], suffixes=("", "_made"))
    found = found[(found["at"] - found.at_made).between(3, 7)]  # the next message of each is five steps younger
    assert found.groupby(KEY).ngroups == (lies["at"] > 15).sum() > 100
    assert set(found.observer_made) == set(honest[honest["at"] > 8].observer)


def test_stale(honest):
    """The content of two messages ago, the vehicle itself included."""
    tables = attacked("stale", {"n_messages": 2})
    found = tables["detections"]
    mine = found[found.observer.isin(WHO) & found.transmitted & (found["at"] >= 2)]
    was = honest["detections"]
    was = was[was.observer.isin(WHO)].assign(at=lambda f: f["at"] + 2)
    pairs = mine.merge(was, on=["at", "observer", "x_m", "y_m", "score"])
    assert len(pairs) == len(mine) == (was["at"] < 6).sum()
    reports = mine[mine.detection_index == 0]
    assert len(reports) == 4 * len(LIARS) and reports.lied.all()


def test_stale_after_a_pause(honest):
    """On in the first half of eight steps: after a pause, content is of two messages ago, too."""
    times = {"when": "on_off", "period_s": 8.0, "duty_p": 0.5, "start_s": 0.0}
    found = attacked("stale", times | {"n_messages": 2}, n_steps=12)["detections"]
    honest = play(n_steps=12)["detections"]
    selves = found[found.observer.isin(WHO) & (found.detection_index == 0) & (found["at"] >= 8)]
    was = honest.query("detection_index == 0").assign(at=lambda f: f["at"] + 2)
    both = selves.merge(was, on=["at", "observer"], suffixes=("", "_was"))
    assert len(both) == 4 * len(WHO) and (both.x_m == both.x_m_was).all()


@pytest.mark.verify
def test_speed(honest):
    tables = attacked("speed", n_steps=40)
    own = lies_of(tables)
    error = own.speed_mps - 10.0
    assert len(own) == 40 * len(LIARS) and error.abs().between(1, 7).all()
    assert abs((error > 0).mean() - 0.5) < 5 * np.sqrt(0.25 / len(own))


def test_self_reports_carry_speed_and_acceleration():
    found = play(speeds=[10.0, 12.0, 9.0], n_steps=3)["detections"]
    own = found[found.detection_index == 0]
    assert own.groupby("at").speed_mps.unique().explode().tolist() == [10.0, 12.0, 9.0]
    assert own.groupby("at").acceleration_mps2.unique().explode().tolist() == [0.0, 2.0, -3.0]
    assert found[found.detection_index > 0][["speed_mps", "acceleration_mps2"]].isna().all().all()


def test_braking():
    """Braking with 3 m/s2 is told as 6 to 12; standing at one speed as 2 to 4."""
    own = lies_of(attacked("braking", n_steps=2, speeds=[12.0, 9.0]))
    told = -own.acceleration_mps2
    assert len(own) == 2 * len(LIARS)
    assert told[own["at"] == 1].between(6, 12).all() and told[own["at"] == 0].between(2, 4).all()


def test_stop():
    """Once stopped, for good, at the place where it began; 5 % per message."""
    found = attacked("stop", {"stop_p": 0.2}, n_steps=12)["detections"]
    own = found[(found.detection_index == 0) & found.observer.isin(WHO)]
    for _, one in own.groupby("observer"):
        stands = (one.speed_mps == 0).to_numpy()
        assert stands.any() and (np.diff(stands.astype(int)) >= 0).all()
        assert one.x_m[stands].nunique() == 1 and one.lied[stands].all() and not one.lied[~stands].any()
        assert one.x_m[~stands].nunique() == (~stands).sum()


EVALUATION_KEY = ["at", "evaluator", "observer", "detection_index"]


def reported(tables, honest):
    rows = beside(tables, honest, "evaluations", EVALUATION_KEY)
    others = rows[rows.evaluator.isin(WHO) & (rows.evaluator != rows.observer)]
    untouched = rows.drop(others.index)
    np.testing.assert_array_equal(untouched.evaluation, untouched.evaluation_was)
    np.testing.assert_array_equal(untouched.visibility, untouched.visibility_was)
    assert not untouched.lied.any() and len(others) > 50
    changed = (others.evaluation * others.visibility - others.evaluation_was * others.visibility_was).abs() > 0.1
    assert (others.lied == changed).all()
    return others


def test_bad_mouthing(honest):
    rows = reported(attacked("bad_mouthing"), honest)
    spared = rows.observer.isin(WHO)
    assert (rows.evaluation[~spared] == -1).all() and (rows.visibility[~spared] == 1).all()
    assert (rows.evaluation[spared] == rows.evaluation_was[spared]).all()


def test_bad_mouthing_of_one_victim(honest):
    keys = {"only_victim": True, "victim": "one", "victim_id": "v11"}
    rows = reported(attacked("bad_mouthing", keys), honest)
    hit = rows.observer == NAMES.index("v11")
    assert hit.sum() > 5 and (rows.evaluation[hit] == -1).all()
    assert (rows.evaluation[~hit] == rows.evaluation_was[~hit]).all()


def test_ballot_stuffing(honest):
    rows = reported(attacked("ballot_stuffing"), honest)
    friends = rows.observer.isin(WHO)
    assert friends.any() and (rows.evaluation[friends] == 1).all() and (rows.visibility[friends] == 1).all()
    assert (rows.evaluation[~friends] == rows.evaluation_was[~friends]).all()


def test_collusion_in_rings_of_two(honest):
    """v00 and v07 appear in one cell, as do v15 and v23: two rings, in the order of their numbers."""
    rows = reported(attacked("collusion", {"ring_size": 2}), honest)
    ring = {0: 0, 7: 0, 15: 1, 23: 1}
    friends = rows.observer.map(ring) == rows.evaluator.map(ring)
    assert friends.any() and (rows.evaluation[friends] == 1).all() and (rows.evaluation[~friends] == -1).all()
    assert (~friends & rows.observer.isin(WHO)).any(), "another ring is no friend"


def test_discrimination(honest):
    rows = reported(attacked("discrimination", {"group_p": 0.3}), honest)
    changed = (rows.evaluation != rows.evaluation_was) | (rows.visibility != rows.visibility_was)
    group = rows.observer[changed].unique()
    assert changed.any() and (rows.evaluation[rows.observer.isin(group)] == -1).all()
    assert 0.05 < len(group) / N < 0.6


def test_random_evaluations(honest):
    rows = reported(attacked("random_evaluations"), honest)
    assert (rows.visibility == 1).all() and abs(rows.evaluation.mean()) < 5 / np.sqrt(3 * len(rows))
    assert rows.evaluation.between(-1, 1).all() and rows.evaluation.nunique() > 0.99 * len(rows)


def test_majority_copying(honest):
    tables = attacked("majority_copying")
    rows = reported(tables, honest)
    votes = honest["evaluations"]
    votes = votes[~votes.evaluator.isin(WHO) & (votes.evaluator != votes.observer) & (votes.visibility > 0)]
    votes = votes.assign(top=votes.evaluation * votes.visibility)
    sums = votes.groupby(["at", "observer", "detection_index"])[["top", "visibility"]].sum()
    mean = (sums.top / sums.visibility).rename("mean").reset_index()
    rows = rows.merge(mean, on=["at", "observer", "detection_index"], how="left")
    np.testing.assert_allclose(rows.evaluation, rows["mean"].fillna(0.0), atol=1e-9)
    assert (rows.visibility[rows["mean"].isna()] == 0).all()


def test_replayed_evaluations(honest):
    rows = reported(attacked("replayed_evaluations", {"n_messages": 2}), honest)
    was = honest["evaluations"].assign(at=lambda f: f["at"] + 2)
    rows = rows[rows["at"] >= 2].merge(was, on=EVALUATION_KEY, how="left", suffixes=("", "_old"))
    known = rows.evaluation_old.notna()
    known &= rows.visibility_old > 0
    assert known.sum() > 50 and (rows.evaluation[known] == rows.evaluation_old[known]).all()
    assert (rows.visibility[known] == rows.visibility_old[known]).all()
    other = rows[~known]  # of the same sender where there is any, else of anybody; something that it saw
    then = {
        (t, v): set(zip(f.evaluation, f.visibility, strict=True))
        for (t, v), f in was[was.visibility > 0].groupby(["at", "evaluator"])
    }
    assert len(other) > 50 and all(
        (e, phi) in then[t, v]
        for t, v, e, phi in zip(other["at"], other.evaluator, other.evaluation, other.visibility, strict=True)
    )


IN_TURNS = {"traffic": {"step_s": 0.2}, "sensing_phase": "random"}
"""Every vehicle sends at a step of its own, one in five."""


def test_ages_in_messages_where_vehicles_send_in_turns(honest_in_turns):
    """Three messages ago is 15 steps ago, and the first messages repeat the oldest."""
    own = honest_in_turns["detections"].query("detection_index == 0")[["at", "observer", "x_m"]]
    found = attacked("stale", {"n_messages": 3}, n_steps=30, **IN_TURNS)["detections"]
    mine = found[(found.detection_index == 0) & found.observer.isin(WHO)]
    age = mine.merge(own.rename(columns={"at": "was"}), on=["observer", "x_m"]).eval("at - was")
    number = mine.groupby("observer").cumcount()
    assert len(age) == len(mine) and age.tolist() == (5 * np.minimum(number, 3)).tolist()

    said = attacked("replayed_evaluations", {"n_messages": 3}, n_steps=30, **IN_TURNS)["evaluations"]
    said = said[said.evaluator.isin(WHO) & (said.observer != said.evaluator)]
    was = honest_in_turns["evaluations"].assign(at=lambda f: f["at"] + 15)
    was = was[was.visibility > 0]
    key = ["at", "evaluator", "observer", "detection_index"]
    pairs = said.merge(was, on=key, suffixes=("", "_old"))
    assert len(pairs) > 50 and (pairs.evaluation == pairs.evaluation_old).all()
    assert (pairs.visibility == pairs.visibility_old).all()


def test_evaluations_under_several_identities(honest):
    """Three identities: each of the attackers' evaluations goes out three times, under three pseudonyms."""
    tables = attacked("bad_mouthing", {"n_identities": 3})
    names = tables["pseudonyms"]
    assert names[names.vehicle.isin(WHO)].groupby("vehicle").identity.apply(sorted).tolist() == [[0, 1, 2]] * len(LIARS)
    said = tables["evaluations"].merge(names, left_on="evaluator", right_on="pseudonym")
    said = said[said.vehicle.isin(WHO)]
    assert (said.groupby(["at", "vehicle", "observer", "detection_index"]).identity.nunique() == 3).all()
    sent = tables["radio"].groupby("message_type").n_sent.sum()
    assert (sent == 6 * (N + 2 * len(LIARS))).all()


def test_sybil(honest):
    """Five ghosts per attacker, each with a pseudonym, a detection message and an evaluation message of its own."""
    tables = attacked("sybil")
    names, found = tables["pseudonyms"], tables["detections"]
    ghosts = found[~found.observer.isin(range(N))]
    assert len(ghosts) == 6 * 5 * len(LIARS) and (ghosts.detection_index == 0).all() and ghosts.lied.all()
    ghosts = ghosts.merge(names, left_on="observer", right_on="pseudonym")
    assert (
        set(ghosts.vehicle) == set(WHO)
        and (ghosts.observer.groupby([ghosts["at"], ghosts.vehicle]).nunique() == 5).all()
    )
    own = found[found.detection_index == 0].set_index(["at", "observer"])
    at = own.loc[list(zip(ghosts["at"], ghosts.vehicle, strict=True))]
    number = ghosts.identity.to_numpy() - 1
    np.testing.assert_allclose(ghosts.x_m, at.x_m.to_numpy() - 5.0 * (number // 2), atol=1e-9)
    np.testing.assert_allclose(ghosts.y_m, at.y_m.to_numpy() + np.where(number % 2 == 0, 2.0, -2.0), atol=1e-9)
    assert (tables["radio"].groupby("message_type").n_sent.sum() == 6 * (N + 5 * len(LIARS))).all()
    heard = tables["receptions"].merge(names, left_on="sender", right_on="pseudonym")
    assert (heard.groupby(["at", "message_type", "vehicle", "receiver"]).identity.nunique()[
        lambda n: n.index.get_level_values("vehicle").isin(WHO)] == 6).all()  # fmt: skip
    evaluated = tables["evaluations"]
    assert evaluated.evaluator.isin(ghosts.observer).any() and evaluated.observer.isin(ghosts.observer).any()
    trusted = tables["trust"]
    assert trusted.subject.isin(ghosts.observer).any()


def test_denial_of_service():
    """Three copies of four vehicles' messages: 40 + 12 frames instead of 40, of the same bytes each."""
    sections = {"radio": {"model": "csma"}}
    plain, flooded = play(**sections), attacked("denial_of_service", {"n_copies": 3}, **sections)
    n, m = (t["radio"][t["radio"].message_type == 0].set_index("at") for t in (plain, flooded))
    assert (n.n_sent == N).all() and (m.n_sent == N + 3 * len(LIARS)).all()
    assert (m.sent_bytes > 1.2 * n.sent_bytes).all() and m.cbr.mean() > 1.04 * n.cbr.mean()
    heard = flooded["receptions"]
    assert not heard.duplicated(["at", "message_type", "sender", "receiver"]).any()


def test_late_copies_count_once(tmp_path):
    """With random phases, rounds are short, and the copies go on in the next ones, also in later steps."""
    flood = (
        "attacks.0.attack=denial_of_service",
        "attacks.0.n_copies=500",
        "attacks.0.start_s=0",
        "traffic.duration_s=2",
    )
    run = open_run(drive(tmp_path / "run", "preset=modern", "record.level=full", *flood))
    n = len(run.receptions)
    assert run.radio.n_delivered.sum() > 2 * n > 0
    assert run.vehicle_channel.n_received.sum() == n
    assert run.latency_histogram.n_delivered.sum() == n
    assert not run.receptions.duplicated(["message_step", "message_type", "sender", "receiver"]).any()


@pytest.mark.verify
@pytest.mark.parametrize("model", ["unit_disk", "csma"])
def test_delay(model):
    sections = {"radio": {"model": model, "unit_disk": {"loss_p": 0.0}}}
    plain, late = play(**sections), attacked("delay", {"delay_s": 0.2}, **sections)
    a, b = (t["receptions"][t["receptions"].message_type == 0] for t in (plain, late))
    pairs = b.merge(a, on=["at", "sender", "receiver"], suffixes=("", "_was"))
    mine = pairs.sender.isin(WHO)
    by = pairs.generation_offset_s - pairs.generation_offset_s_was
    assert mine.sum() > 50
    np.testing.assert_allclose(by[mine], 0.2, atol=1e-6)
    np.testing.assert_allclose(by[~mine], 0.0, atol=1e-6)
    too_late = attacked("delay", {"delay_s": 0.45}, **sections)["receptions"]
    assert not too_late[too_late.message_type == 0].sender.isin(WHO).any()


def test_server_flooding():
    """A cell with room for about all honest reports: copies push others out."""
    cell = {"delay_min_s": 0.001, "delay_mean_s": 0.002, "uplink_loss_p": 0.0, "cell_up_bytes_per_s": 400_000.0,
            "cell_m": 1e5}  # fmt: skip
    plain, flooded = (play(a, server={"cellular": cell})["server"] for a in ([], [BY | {
        "attack": "server_flooding", "n_reports": 100}]))  # fmt: skip
    assert plain.n_over_capacity.sum() == 0 and flooded.n_over_capacity.sum() > 100
    assert (flooded.uplink_bytes > 5 * plain.uplink_bytes).all() and (flooded.n_reports == plain.n_reports).all()


def test_share_0_changes_nothing(honest):
    """All attacks at once, carried out by none: the same tables. Jamming is left out: this radio has no channel."""
    tables = play([{"attack": attack, "share_p": 0.0} for attack in ATTACKS if attack != "jamming"])
    assert tables.keys() == honest.keys()
    for name in honest:
        pd.testing.assert_frame_equal(tables[name], honest[name], check_exact=True)
