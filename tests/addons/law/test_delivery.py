"""Delivery on an idle channel and over the cellular network, against draws of the models themselves."""

import numpy as np
import pytest

from cosim.addons.law.delivery import LinkPairs, Load, arrival_p, expected_cpm_bytes, received_p
from cosim.base import rng
from cosim.messages.cellular import CellularParams, transfer_delay_s
from cosim.messages.content import NETWORK_BYTES, SIGNATURE_BYTES
from cosim.messages.cpm import cpm_bytes
from cosim.messages.cpm_params import CpmParams
from cosim.radio.message_round import EarlierMessages, MessageRound, Messages, RoundKind, Stations
from cosim.radio.phy import CURVES, ReceiverParams
from cosim.radio.propagation import fading_quantiles


@pytest.mark.parametrize(("loss_p", "n_retries"), [(0.01, 2), (0.4, 0), (0.4, 3)])
def test_arrival_as_drawn(loss_p, n_retries):
    n, params = 40_000, CellularParams()
    delay_s = transfer_delay_s(rng.key(3, rng.Stream.UPLINK), np.arange(n).astype(np.uint64), loss_p, n_retries, params)
    at_s = np.array([0.04, 0.1, 0.2, 0.5, 1.0, 3.0])
    drawn = (delay_s[:, None] <= at_s).mean(axis=0)
    assert arrival_p(at_s, loss_p, n_retries, params) == pytest.approx(drawn, abs=4 * np.sqrt(0.25 / n))


def test_arrival_without_spread_by_hand():
    # Both attempts take 0.1 s: 3/4 arrive after 0.1 s, and 1/4 * 3/4 more after 0.2 s.
    params = CellularParams(delay_min_s=0.1, delay_mean_s=0.1)
    assert arrival_p(np.array([0.05, 0.1, 0.2]), 0.25, 1, params) == pytest.approx([0, 0.75, 0.9375])


def test_received_as_by_the_receiver():
    params, random = ReceiverParams(), np.random.default_rng(1)
    x0, w = CURVES["table"][6.0]
    for power_dbm, fading, length in (
        (-93.0, 2, 320),
        (-88.5, 3, 700),
        (-80.2, 2, 1434),
        (-95.0, 0, 320),
        (-60.0, 3, 64),
    ):
        gain = fading_quantiles()[fading][random.integers(0, 4096, 40_000)]
        dbm = power_dbm + 10 * np.log10(gain)
        psr = np.exp(-(length / 336) * np.exp(np.minimum((x0 - (dbm - params.noise_dbm)) / w, 50)))
        want = np.mean((dbm >= params.detectable_dbm) * psr)
        got = received_p(np.array([power_dbm]), np.array([fading]), np.array([length]), params)[0]
        assert got == pytest.approx(want, abs=0.02)


def test_expected_lengths_are_those_of_the_encoder():
    n, moving = np.array([1.0, 7.0, 30.0]), np.array([[1, 0, 0, 0], [4, 1, 2, 0], [20, 5, 3, 2]])
    encoded = NETWORK_BYTES + SIGNATURE_BYTES + cpm_bytes(np.zeros((3, 4), int), n_moving=moving)
    assert expected_cpm_bytes(CpmParams(length="uper"), n) == pytest.approx(encoded, abs=8)
    assert expected_cpm_bytes(CpmParams(length="linear"), n).tolist() == [215, 389, 1056]


class OneStepLate:
    """A medium on which every message from station 7 reaches station 9 in the step after its own."""

    def broadcast(self, sent_in, kind, number, begin_s, stations, messages):
        """What happened in one step; the state is the step before, in which the message was sent."""
        happened = MessageRound.silent()
        if sent_in is not None:
            row = {key: [at] for at, key in enumerate(stations.key.tolist())}
            one = Messages(np.array(row[7]), np.array([100]))
            late = MessageRound.of(stations, one, np.array(row[9]), np.zeros(1, int))
            earlier = EarlierMessages(kind, np.array([sent_in]), np.array([-1]), late)
            happened = MessageRound(happened.station, happened.receptions, happened.frames, (earlier,))
        return number, happened


@pytest.mark.parametrize(("wait_steps", "n_received"), [(0, 0), (1, 1)])
def test_a_message_that_arrives_in_a_later_step_counts_if_its_receiver_has_not_sensed_yet(wait_steps, n_received):
    """In the second step the stations have other rows."""
    load, kind = Load(OneStepLate(), None, 2), RoundKind.EVALUATION
    for number, keys in enumerate(([7, 9], [9, 7])):
        links, length_bytes = one_link(keys), np.array([100.0, 0.0]) * (number == 0)
        load.delivered_p(kind, number, 0.1 * number, links, length_bytes, np.array([5, wait_steps]))
    assert (load.expected[kind].sum(), load.received[kind].sum()) == (1, n_received)


def one_link(keys):
    """From station 7 to station 9, without losses."""
    sender = np.array([keys.index(7)])
    stations = Stations(np.array(keys, np.uint64), np.zeros((2, 3)), 2)
    return LinkPairs(sender, 1 - sender, lambda length_bytes: length_bytes[sender] / 100, 0 * sender, stations)
