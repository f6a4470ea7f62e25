"""The newest sweeps and messages of vehicles that sense at different times, by hand."""

import numpy as np

from cosim.addons.law.newest import NewestReceived, SweepTimes
from cosim.addons.law.opportunities import ViewTimes


def received(*rows):
    sender, receiver, p = (np.array(column) for column in zip(*rows, strict=True))
    return NewestReceived(sender, receiver, p.astype(float), np.zeros(len(p)))


def test_a_newer_message_replaces_the_older_one_and_vehicles_leave():
    first = received((1, 2, 0.5), (1, 3, 0.6), (2, 1, 0.7))
    # Vehicle 1 sends again and reaches 2 alone; vehicle 3 has left.
    then = first.then(received((1, 2, 0.9)), np.array([1]), np.array([1, 2]))
    assert list(zip(then.sender, then.receiver, then.p, strict=True)) == [(2, 1, 0.7), (1, 2, 0.9)]
    # A sender whose newest message reaches nobody has none that is newer than this.
    assert len(first.then(NewestReceived.none(), np.array([1]), np.array([1, 2])).sender) == 1
    assert then.by(np.array([2])).sender.tolist() == [1]


def views(own, ptr, body, seen_p):
    k = len(body)
    return ViewTimes(
        np.array(own),
        np.array(ptr),
        np.array(body, np.int64),
        np.array(seen_p, float),
        np.ones(k, bool),
        np.zeros(k),
        0.5,
    )


def test_sweeps_are_kept_by_actor():
    # Rows of the world are other actors in each step.
    one = SweepTimes.none().then(views([0, 2], [0, 2, 3], [1, 2, 0], [0.1, 0.2, 0.3]), np.array([10, 11, 12]), 4,
                             np.array([10, 12]))  # fmt: skip
    assert one.views.own.tolist() == [10, 12] and one.views.body.tolist() == [11, 12, 10]
    # Then actor 11 senses, actor 10 has left, and 12 keeps its sweep of step 4.
    two = one.then(views([0], [0, 1], [1], [0.9]), np.array([11, 12]), 5, np.array([11, 12]))
    assert two.views.own.tolist() == [11, 12] and two.step.tolist() == [5, 4]
    assert two.views.ptr.tolist() == [0, 1, 2] and two.views.body.tolist() == [12, 10]
    assert two.views.seen_p.tolist() == [0.9, 0.3] and two.views.n_false == 0.5
