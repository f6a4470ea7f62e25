"""Redundancy mitigation by hand, and what receivers remember. The twin is in `test_cpm_twin.py`."""

from dataclasses import replace

import numpy as np

from cosim.messages.cpm_params import CpmParams
from cosim.messages.redundancy import Candidates, Heard, ReportedObjects, redundant

CAR, PEDESTRIAN = 0, 1


def said(time_s, *objects, sender=7, sender_x=0.0):
    """One message; objects are (x, label, speed to the east, is the sender itself)."""
    x, label, speed, is_self = (np.array(column) for column in zip(*objects, strict=True))
    n, still = len(x), np.zeros(len(x))
    return ReportedObjects(
        np.array([time_s]), np.array([sender]), np.array([[sender_x, 0.0]]), np.zeros(n, int), label.astype(np.int64),
        np.column_stack([x, still]).astype(float), np.column_stack([speed, still]).astype(float), is_self.astype(bool),
    )  # fmt: skip


def after(*messages, receiver=1, window_s=1.0):
    """What vehicle 1 has heard of these messages, each received 10 ms after it was sensed."""
    heard = Heard.start()
    for reports in messages:
        got = np.array([receiver]), np.zeros(1, int), reports.time_s + 0.01
        heard = heard.next(reports, *got, window_s)
    return heard


def seen(*objects, receiver=1, own_x=100.0):
    """Objects (x, label, speed) that vehicle 1 is about to report."""
    x, label, speed = (np.array(column) for column in zip(*objects, strict=True))
    n = len(x)
    return Candidates(
        np.full(n, receiver), np.full((n, 2), (own_x, 0.0)), label.astype(np.int64),
        np.column_stack([x, np.zeros(n)]).astype(float), speed.astype(float),
    )  # fmt: skip


def rule(name, **more):
    return CpmParams(redundancy=name, **more)


def test_more_than_five_reports_in_a_second():
    def heard(n):
        return after(*(said(0.1 * i, (30, CAR, np.nan, False)) for i in range(n)))

    mine = seen((31, CAR, np.nan), (37, CAR, np.nan), (31, PEDESTRIAN, np.nan))
    assert redundant(heard(5), mine, 0.9, rule("frequency")).tolist() == [False] * 3
    assert redundant(heard(6), mine, 0.9, rule("frequency")).tolist() == [True, False, False]
    assert redundant(heard(6), mine, 1.05, rule("frequency")).tolist() == [False] * 3, "the first is too old"
    assert redundant(heard(6), seen((31, CAR, np.nan), receiver=2), 0.9, rule("frequency")).tolist() == [False]
    twice = after(*(said(0.1 * i, (30, CAR, np.nan, False), (32, CAR, np.nan, False)) for i in range(3)))
    assert not redundant(twice, mine, 0.9, rule("frequency")).any(), "a message counts once"
    assert redundant(twice, mine, 0.9, rule("frequency", redundancy_reports=2)).tolist() == [True, False, False]


def test_place_and_speed_since_the_latest_report():
    """At 0.5 s, the reports of 0 s lie at 30 m, 10 m/s: the object is expected at 35 m."""
    heard = after(said(0.0, (30, CAR, 10.0, False)))
    mine = seen((33.9, CAR, 10.5), (34.1, CAR, 10.0), (33.9, CAR, 10.625), (33.9, CAR, np.nan))
    assert redundant(heard, mine, 0.5, rule("dynamics")).tolist() == [True, False, False, True]
    assert redundant(heard, seen((31, CAR, 10.0)), 0.6, rule("dynamics")).tolist() == [False], "5 m off: another one"
    newer = after(said(0.0, (30, CAR, 10.0, False)), said(0.4, (33.5, CAR, 12.0, False), sender=3))
    assert redundant(newer, seen((33.9, CAR, 10.0)), 0.5, rule("dynamics")).tolist() == [False], "the latest counts"
    some = rule("dynamics", redundancy_moved_m=3.0, redundancy_speed_mps=1.0)
    assert redundant(heard, seen((32.9, CAR, 11.0), (33.1, CAR, 10.0)), 0.5, some).tolist() == [True, False]


def test_senders_nearby():
    mine = seen((30, CAR, np.nan), own_x=100.0)
    for x, expected in ((90.0, True), (89.9, False), (110.0, True)):
        heard = after(said(0.0, (30, CAR, np.nan, False), sender_x=x))
        assert redundant(heard, mine, 0.5, rule("distance")).tolist() == [expected]
    far = rule("distance", redundancy_sender_m=11.0)
    assert redundant(after(said(0.0, (30, CAR, np.nan, False), sender_x=89.9)), mine, 0.5, far).tolist() == [True]


def test_reports_of_itself():
    heard = after(said(0.0, (30, CAR, 0.0, True), (60, CAR, 0.0, False)))
    mine = seen((30, CAR, 0.0), (60, CAR, 0.0))
    assert redundant(heard, mine, 0.5, rule("self_announcement")).tolist() == [True, False]
    assert redundant(heard, mine, 0.5, rule("dynamics")).tolist() == [False, True]
    assert redundant(heard, mine, 0.5, rule("none")).tolist() == [False, False]


def test_memory_is_bounded_by_the_window():
    heard, sizes = Heard.start(), []
    for step in range(60):
        reports = said(step / 10, *[(i, CAR, 0.0, False) for i in range(20)], sender=step % 4)
        heard = heard.next(reports, np.arange(5), np.zeros(5, int), np.full(5, step / 10 + 0.02), 1.0)
        sizes.append((len(heard.reports.time_s), len(heard.reports.label), len(heard.receiver)))
    assert max(sizes) == sizes[-1] == (11, 220, 55) and sizes[20:] == sizes[20:21] * 40
    silence = ReportedObjects.none()
    unheard = replace(said(9.0, (1, CAR, 0.0, False)))
    none = np.zeros(0, int)
    heard = heard.next(unheard, none, none, np.zeros(0), 1.0)
    assert (len(heard.receiver), len(heard.reports.label)) == (0, 0), "what nobody received is not kept"
    assert heard.next(silence, none, none, np.zeros(0), 1.0) is heard
