"""How long the truth about what a driver may react to is kept."""

from types import SimpleNamespace

import numpy as np
import pytest

from cosim.addons.driver.cautious import Cautious, CautiousParams
from cosim.step.reactions import ReactionTruth
from cosim.traffic.driver import memory_s


@pytest.mark.parametrize(("release_s", "oldest"), [(1.0, 39), (30.0, 10)])
def test_truth_is_kept_as_long_as_a_driver_may_react(release_s, oldest):
    """Steps of 1 s, and nothing detected; the next one is step 40."""
    kept_s = memory_s(Cautious(CautiousParams(release_s=release_s)))
    none = np.zeros(0, np.int64)
    listed = SimpleNamespace(
        truth=SimpleNamespace(is_real=none, actor_row=none),
        detections=SimpleNamespace(message=none),
        objects=SimpleNamespace(detection_index=none, origin=none),
    )
    truth = ReactionTruth()
    for step in range(41):
        exchange = SimpleNamespace(
            world=SimpleNamespace(step=step, actor=none), senders=SimpleNamespace(pseudonym=none)
        )
        truth = truth.next(exchange, listed, kept_s, 1.0)
    assert [then.step for then in truth.steps] == list(range(oldest, 41))
