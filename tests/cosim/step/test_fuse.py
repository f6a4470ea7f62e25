"""Trust in the senders of what vehicles fuse, and in oneself."""

import numpy as np
import pytest

from cosim.step import cycle
from cosim.step.fuse import trust_in_senders
from cosim.step.known import Uses
from cosim.step.state import State
from tests.scene import ScriptedScene, parts_of

LOCAL = ("attacks.0.start_s=1000", "trust.host=local")
"""Vehicles keep trust themselves. What they hold after a step is what they have looked up in it."""

LOSSES = ("radio.model=unit_disk", "radio.unit_disk.loss_p=0.4")


def played(n, *overrides):
    """Results of the first steps, each with the state after it."""
    scene = ScriptedScene.load()
    parts = parts_of(scene, *LOCAL, *overrides)
    state = State.start(parts)
    for number in range(n):
        state, result = cycle.step(scene.world(number), state, parts)
        yield result.sensed, state, parts


def held(sensed, state, parts, uses):
    """Trust of vehicles in the senders of messages, as they hold it."""
    vehicle, subject = sensed.sensing.actor[uses.receiver], sensed.known.pseudonym[uses.message]
    return parts.trust.lookup(state.trust, vehicle, subject, 1e6)[0].trust


def pairs_of(uses):
    return set(zip(uses.receiver.tolist(), uses.message.tolist(), strict=True))


def test_a_sender_whose_evaluations_are_lost_keeps_its_trust():
    """Four in ten messages are lost. All senders of detections that a vehicle uses count by the trust held in them."""
    n_lost = n_different = 0
    for sensed, state, parts in played(14, *LOSSES):
        looked_up, owners = sensed.looked_up, len(sensed.sensing)
        assert pairs_of(looked_up.further) == pairs_of(sensed.known.received) - pairs_of(looked_up.messages)
        trust = held(sensed, state, parts, looked_up.further)
        np.testing.assert_array_equal(looked_up.of_further[0], trust)
        n_lost += len(trust)
        n_different += (trust != parts.config.trust.default_trust).sum()
        of_senders = trust_in_senders(looked_up, [0], True, owners)[0]
        assert of_senders.canonical() is of_senders and len(of_senders.ptr) == owners + 1
        senders = Uses(np.repeat(np.arange(owners), np.diff(of_senders.ptr)), of_senders.message)
        assert pairs_of(senders) == pairs_of(looked_up.messages) | pairs_of(looked_up.further)
        reporting = np.flatnonzero(of_senders.arrived())
        assert pairs_of(Uses(*(column[reporting] for column in senders))) == pairs_of(looked_up.messages)
    assert n_lost > 10 and n_different > 10


def test_fused_scores_are_means_weighted_by_the_trust_that_is_held(monkeypatch):
    """Objects of two detections, one's own and that of a sender whose evaluations are lost: (s + s' T) / (1 + T)."""
    given, fuse = [], cycle.fuse_objects

    def noted(trust, groups, *rest):
        given.append(groups)
        return fuse(trust, groups, *rest)

    monkeypatch.setattr(cycle, "fuse_objects", noted)
    n_checked = 0
    for sensed, state, parts in played(14, "trust.method=averaging", *LOSSES):
        fused, groups, further = sensed.fused()[0], given[-1], sensed.looked_up.further
        trust = dict(zip(pairs_of(further), held(sensed, state, parts, further).tolist(), strict=True))
        lists, detections, number = groups.lists, groups.detections, groups.groups.numbers()
        for ego, group, score in zip(fused.ego, fused.group, fused.score, strict=True):
            member = lists.member[number == group]
            message = detections.message[member].tolist()
            by = dict(zip(message, detections.score[member].tolist(), strict=True))
            others = [one for one in message if one != lists.owner[ego]]
            if len(message) == 2 and len(others) == 1 and (int(ego), others[0]) in trust:
                weight = trust[int(ego), others[0]]
                mean = (by[int(lists.owner[ego])] + by[others[0]] * weight) / (1 + weight)
                assert score == pytest.approx(mean, rel=1e-12)
                n_checked += weight != parts.config.trust.default_trust
    assert n_checked > 3


@pytest.mark.parametrize("overrides", [("trust.ego_trust_from=computed",), ("trust.code_parity=true",)])
def test_a_vehicle_weighs_itself_by_the_trust_that_it_holds_in_itself(overrides):
    *_, (sensed, state, parts) = played(12, *overrides)
    own = sensed.looked_up.own[0]
    vehicle, subject = sensed.sensing.actor, sensed.sensing.pseudonym
    np.testing.assert_array_equal(own, parts.trust.lookup(state.trust, vehicle, subject, 1e6)[0].trust)
    assert (own != parts.config.trust.default_trust).any()
    of_senders = trust_in_senders(sensed.looked_up, [0], True, len(own))[0]
    np.testing.assert_array_equal(of_senders.of_egos(parts.config.trust.fixed_ego_trust), own)
    np.testing.assert_array_equal(of_senders.of_egos(2.0), np.full(len(own), 2.0))


def test_without_such_a_variant_nobody_asks_for_its_own_trust():
    ((sensed, _, _),) = played(1)
    assert sensed.looked_up.own is None
