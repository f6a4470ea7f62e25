"""Relay control: a vehicle does not forward the messages of senders whom it trusts too little."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from cosim.addons.compare.scenarios import ScriptedScene
from cosim.config.config import load
from cosim.radio.message_round import Messages
from cosim.radio.unit_disk import UnitDiskMedium
from cosim.step.cycle import step
from cosim.step.exchange import OnAir
from cosim.step.state import State
from tests.scene import parts_of, play

SCENE = ("radio.model=unit_disk", "radio.relay.max_hops=3", "radio.unit_disk.loss_p=0", "trust.server_period_s=0.1")


@dataclass(frozen=True)
class Listening(UnitDiskMedium):
    """The unit disk; it keeps what stations refuse to forward."""

    refused: list = field(default_factory=list)

    def broadcast(self, state, kind, step, begin_s, stations, messages):
        self.refused.append(messages.refused)
        return super().broadcast(state, kind, step, begin_s, stations, messages)


def controlled(n, *overrides):
    """Steps 0 to n - 1, and for each the refused pairs (row of the message, row of the vehicle) of both rounds."""
    scene = ScriptedScene.load()
    parts = parts_of(scene, *SCENE, *overrides)
    medium = Listening(parts.config.radio, parts.config.round_s, 1)
    parts, sensed = replace(parts, medium=medium), []
    state = State.start(parts)
    for number in range(n):
        state, result = step(scene.world(number), state, parts)
        sensed.append(result.sensed)
    pairs = [{(code >> 32, code & 0xFFFFFFFF) for code in codes.tolist()} for codes in medium.refused]
    assert all((np.diff(codes) > 0).all() for codes in medium.refused)
    return sensed, pairs


def test_a_relay_uses_the_trust_that_it_had_when_the_step_began():
    """Every vehicle has the broadcast of the step before: its values, and the default for those it does not name.

    The attacker forwards everything.
    """
    sensed, pairs = controlled(12, "radio.relay.min_trust=0.45", "attacks.0.start_s=0")
    known, n_refused, n_forwarded = {}, 0, 0
    for number, now in enumerate(sensed):
        named = now.senders.pseudonym.tolist()
        vehicles = np.flatnonzero(now.positioned.world.attack[now.vehicles.row] == 0).tolist()
        expected = {
            (m, v) for m in range(len(named)) for v in vehicles
            if v != now.senders.vehicle[m] and known.get(named[m], 0.5) < 0.45
        }  # fmt: skip
        assert pairs[2 * number] == pairs[2 * number + 1] == expected
        n_refused, n_forwarded = n_refused + len(expected), n_forwarded + now.rounds[0].round.frames.n_relayed
        scores = now.published[0]
        valued = scores.is_evaluated
        known = dict(zip(scores.subject[valued].tolist(), scores.trust[valued].tolist(), strict=True))
    assert n_refused and n_forwarded


def test_unknown_senders_have_the_default():
    """In step 0 nobody has trust in anyone, so that all messages are forwarded, or none is."""
    assert controlled(1, "radio.relay.min_trust=0.5")[0][0].rounds[0].round.frames.n_relayed > 0
    assert controlled(1, "radio.relay.min_trust=0.51")[0][0].rounds[0].round.frames.n_relayed == 0


def test_vehicles_hold_trust_of_their_own():
    """With trust.host = "local" only those refuse the attacker's message who have denied something of it."""
    sensed, pairs = controlled(
        12, "radio.relay.min_trust=0.45", "trust.host=local", "trust.local_evidence=own", "attacks.0.start_s=0"
    )
    seen: set[tuple[int, int]] = set()
    for number, now in enumerate(sensed):
        assert pairs[2 * number] <= seen
        own, lists = now.evaluated.own, now.evaluated.lists
        message = now.known.detections.message[lists.member]
        denied = (own.evaluation < 0) & (own.visibility > 0) & (message != lists.of_member())
        seen |= set(zip(message[denied].tolist(), lists.of_member()[denied].tolist(), strict=True))
    assert pairs[-1]


def test_copies_of_a_message_are_refused_as_it_is():
    """Message 1 is on the air in frames 1 and 3; vehicle 5 refuses it."""
    frames = OnAir(Messages(np.array([0, 1, 1, 1]), np.full(4, 100)), np.array([0, 1, 2, 1]))
    refused = frames.without((np.array([1, 2]), np.array([5, 4]))).messages.refused
    assert refused.tolist() == [(1 << 32) + 5, (2 << 32) + 4, (3 << 32) + 5]
    assert frames.without(None) is frames


def test_without_control_nothing_is_refused_and_nothing_changes():
    one, _ = play(2, *SCENE)
    other, _ = play(2, *SCENE, "radio.relay.min_trust=0")
    assert one[1].rounds[0].round.frames.n_relayed == other[1].rounds[0].round.frames.n_relayed > 0


def test_trust_is_needed():
    keys = ["radio.relay.max_hops=2", "radio.relay.min_trust=0.3", "trust.host=none"]
    with pytest.raises(ValueError, match=r'but trust[.]host = "none"'):
        load(None, keys)
    load(None, keys[1:])  # without forwarding the key has no effect, and says so elsewhere
