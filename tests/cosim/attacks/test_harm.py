"""Each attack does its documented harm with its default parameters: in the tables, beside the steps without it.

What exactly an attack changes is the business of `test_library.py`; here it is enough that it has an effect.
"""

from functools import cache

import numpy as np
import pytest

from cosim.attacks.catalogue import ATTACKS
from cosim.base.plane import turned_by
from cosim.step.attack_outcomes import _in_path
from sensors.boxes import Boxes
from tests.cosim.attacks.plain import NAMES, play

LIARS = [0, 7, 15, 23]
TABLES = ("detections", "evaluations", "fused", "radio", "receptions", "server", "trust")


@cache
def tables_of(attack, n_steps, who, penetration_p):
    """Steps over a channel with collisions, with an attack or honest (None)."""
    attacks = [{"attack": attack, "ids": [NAMES[v] for v in who]}] if attack else []
    return play(attacks, n_steps, penetration_p, radio={}, tables=TABLES)


def last_rows(tables):
    """Trust at the server at the end."""
    rows = tables["trust"]
    return rows[rows["at"] == rows["at"].max()]


def last_trust(tables, of_attackers):
    """Mean trust at the server at the end."""
    rows = last_rows(tables)
    return rows.trust[rows.subject.isin(LIARS) == of_attackers].mean()


def cpms(tables):
    """Sums over the detection messages of all steps."""
    rows = tables["radio"]
    return rows[rows.message_type == 0].drop(columns="at").sum()


def pdr(tables):
    """Share of the detection messages that are delivered."""
    sums = cpms(tables)
    return sums.n_delivered / sums.n_in_range


def ghosts_are_believed(found, honest):
    """Fused objects that are made up."""
    return found["fused"].fabricated.sum() > honest["fused"].fabricated.sum() == 0


def objects_are_missing(found, honest):
    """Detections that are not sent."""
    return not found["detections"].transmitted.all() and honest["detections"].transmitted.all()


def lists_are_wrong(found, honest):
    """Falsified detections are sent, and evaluators of their senders or objects disagree more often."""
    lies = found["detections"].lied & found["detections"].transmitted
    return lies.any() and (found["evaluations"].evaluation < 0).sum() > (honest["evaluations"].evaluation < 0).sum()


def content_is_wrong(found, honest):
    """Falsified content is sent in a column that evaluations do not read."""
    return (found["detections"].lied & found["detections"].transmitted).any() and not honest["detections"].lied.any()


def honest_lose_trust(found, honest):
    """Trust in vehicles that do not attack falls."""
    return last_trust(found, False) < last_trust(honest, False) - 0.02


def victims_lose_trust(found, honest):
    """Trust in vehicles that report phantoms falls, and the trust in all others stays what it is."""
    rows = found["detections"]
    victims = rows.observer[(rows.origin == 0) & rows.target.notna()].unique()
    was, now = (last_rows(tables).set_index("subject").trust for tables in (honest, found))
    loss = was - now
    is_victim = loss.index.isin(victims)
    return is_victim.any() and (loss[is_victim] > 0.02).all() and (loss[~is_victim] == 0).all()


def attackers_gain_trust(found, honest):
    """Trust in those that attack rises."""
    return last_trust(found, True) > last_trust(honest, True) + 0.02


def evaluations_are_wrong(found, honest):
    """At least 2 % of all evaluations, most of those of four in forty vehicles, are not what their senders think."""
    lies = found["evaluations"].lied
    return lies.mean() > 0.02 and (found["evaluations"].visibility[lies] > 0).mean() > 0.5


def delivery_falls(found, honest):
    """Fewer detection messages are delivered, by interference."""
    return pdr(found) < pdr(honest) - 0.05 and cpms(found).n_lost_collision > cpms(honest).n_lost_collision + 100


def messages_are_late(found, honest):
    """Some are lost because the round is over, the others are generated later than any honest one."""
    rows = found["receptions"]
    rows = rows[(rows.message_type == 0) & rows.sender.isin(LIARS)]
    return cpms(found).n_lost_expired > 50 and len(rows) > 20 and (rows.generation_offset_s > 0.3 - 1e-9).all()


def reports_are_lost(found, honest):
    """The cell is full: reports do not reach the server."""
    return found["server"].n_over_capacity.sum() > 0.5 * honest["server"].n_reached.sum()


def both(*harms):
    """All of them."""
    return lambda found, honest: all(harm(found, honest) for harm in harms)


HARM = {
    "ghost_insertion": ghosts_are_believed,
    "unreliable": both(ghosts_are_believed, objects_are_missing),
    "approaching_ghost": ghosts_are_believed,
    "ghost_in_shadow": ghosts_are_believed,
    "replay": ghosts_are_believed,
    "stale": both(ghosts_are_believed, objects_are_missing),
    "removal": objects_are_missing,
    "offset": lists_are_wrong,
    "drift": content_is_wrong,
    "mirror": lists_are_wrong,
    "heading": content_is_wrong,
    "size": lists_are_wrong,
    "classification": lists_are_wrong,
    "score": content_is_wrong,
    "misstated_accuracy": content_is_wrong,
    "speed": content_is_wrong,
    "braking": content_is_wrong,
    "stop": content_is_wrong,
    "trust_flip": victims_lose_trust,
    "bad_mouthing": honest_lose_trust,
    "ballot_stuffing": attackers_gain_trust,
    "collusion": both(honest_lose_trust, attackers_gain_trust),
    "discrimination": honest_lose_trust,
    "random_evaluations": both(evaluations_are_wrong, honest_lose_trust),
    "majority_copying": evaluations_are_wrong,
    "replayed_evaluations": evaluations_are_wrong,
    "sybil": both(ghosts_are_believed, attackers_gain_trust),
    "denial_of_service": delivery_falls,
    "jamming": delivery_falls,
    "delay": messages_are_late,
    "server_flooding": reports_are_lost,
}
"""By attack, what its documentation says that it does."""

ALL, FEW = tuple(range(40)), tuple(LIARS)
SCENES = {
    "drift": (3, FEW, 1.0),  # 0.5 m/s
    "stop": (2, ALL, 1.0),  # 5 % per message
    "ghost_in_shadow": (2, ALL, 0.1),  # where every vehicle looks there is no shadow
}
"""Steps, attackers and share of the equipped vehicles, where they are not two, four and all."""


def test_every_attack_has_a_harm():
    assert sorted(HARM) == sorted(ATTACKS)


@pytest.mark.parametrize("attack", HARM)
def test_harm(attack):
    n_steps, who, penetration_p = SCENES.get(attack, (2, FEW, 1.0))
    found = tables_of(attack, n_steps, who, penetration_p)
    assert HARM[attack](found, tables_of(None, n_steps, FEW, penetration_p)), HARM[attack].__doc__


def test_a_reactive_jammer_disturbs_as_a_constant_one_does():
    attack = {"attack": "jamming", "mode": "reactive", "ids": [NAMES[v] for v in LIARS]}
    assert delivery_falls(play([attack], 2, radio={}, tables=TABLES), tables_of(None, 2, FEW, 1.0))


def test_jamming_needs_a_channel_with_noise():
    with pytest.raises(ValueError, match=r"attacks.0.attack .*jamming.*unit_disk"):
        play([{"attack": "jamming"}], 1, radio={"model": "unit_disk"})


def test_replayed_evaluations_are_not_silent():
    """Where the attacker had something to say then, it says it: hardly any evaluation has visibility 0."""
    rows = tables_of("replayed_evaluations", 2, FEW, 1.0)["evaluations"]
    rows = rows[(rows["at"] == 1) & rows.evaluator.isin(LIARS) & (rows.observer != rows.evaluator)]
    assert len(rows) > 100 and (rows.visibility > 0).all()
    assert np.isfinite(rows.evaluation).all()


def test_a_box_that_reaches_into_the_path_is_in_it():
    """The path is 2 m wide. A box of 4.5 x 1.8 m reaches 0.9 m to each side along it, and 2.25 m across it."""
    ahead_m = [20, 20, 20, 20, -1, 49, 51]
    left_m = [1.8, 2.0, -3.2, -3.3, 0, 0, 0]
    turn_rad = np.radians([0, 0, 90, 90, 0, 0, 0])
    away_m = np.column_stack([ahead_m, left_m]).astype(float)
    east_m, north_m = turned_by(np.full(7, 0.5), away_m).T
    own_lwh_m, lwh_m = np.full((7, 3), 2.0), np.tile([4.5, 1.8, 1.5], (7, 1))
    own = Boxes(np.zeros((7, 3)), own_lwh_m, np.full(7, 0.5))
    centre_m = np.column_stack([east_m, north_m, np.zeros(7)])
    boxes = Boxes(centre_m, lwh_m, 0.5 + turn_rad)
    assert _in_path(own, boxes).tolist() == [True, False, True, False, False, True, False]
