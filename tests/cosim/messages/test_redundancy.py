"""What receivers remember, and the limits of redundancy mitigation. The twin of its rules is in `test_cpm_twin.py`."""

from dataclasses import replace

import numpy as np

from cosim.messages.cpm_params import CpmParams
from cosim.messages.redundancy import Heard, ReportedObjects

CAR = 0


def said(time_s, *objects, sender=7, sender_x=0.0):
    """One message; objects are (x, label, speed to the east, is the sender itself)."""
    x, label, speed, is_self = (np.array(column) for column in zip(*objects, strict=True))
    n, still = len(x), np.zeros(len(x))
    return ReportedObjects(
        np.array([time_s]), np.array([sender]), np.array([[sender_x, 0.0]]), np.zeros(n, int), label.astype(np.int64),
        np.column_stack([x, still]).astype(float), np.column_stack([speed, still]).astype(float), is_self.astype(bool),
    )  # fmt: skip


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


def test_limits_are_those_of_the_standards_study():
    p = CpmParams()
    assert (p.redundancy_window_s, p.redundancy_reports, p.redundancy_moved_m, p.redundancy_speed_mps) == (1, 5, 4, 0.5)
    assert p.redundancy_sender_m == 10
