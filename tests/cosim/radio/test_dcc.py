import numpy as np
import pytest

from cosim.radio.dcc import STATES, DccParams, DccState, gap_ns, update

KEY = np.array([7, 3, 5], np.uint64)
ON_AIR_NS = np.full(3, 500_000)


def after(busy, periods, params=None, control=None):
    params, control = params or DccParams(), control or DccState.start()
    for _ in range(periods):
        control = update(control, KEY, np.asarray(busy, float), params)
    return control


def test_the_table():
    # Long after, the smoothed ratio is the ratio: each band has its state.
    for busy, level, ms in (
        (0.1, 0, 50),
        (0.31, 1, 100),
        (0.35, 1, 100),
        (0.45, 2, 200),
        (0.6, 3, 250),
        (0.9, 4, 1000),
    ):
        control = after([busy] * 3, 60)
        assert STATES[control.of(KEY).level[0]] == STATES[level]
        assert gap_ns(control, KEY, DccParams(), ON_AIR_NS).tolist() == [ms * 1_000_000] * 3


def test_one_step_per_period_on_a_running_mean():
    # From 0, busy 1: mean .5, .75, .875, ...: wanted 3, 4, 4, 4; reached 1, 2, 3, 4.
    assert [after([1.0] * 3, k).level[0] for k in range(1, 6)] == [1, 2, 3, 4, 4]
    assert after([1.0] * 3, 2).cbr == pytest.approx([0.75] * 3)
    # And back: mean .5, .25, .125 from 1.
    full = after([1.0] * 3, 40)
    assert [after([0.0] * 3, k, control=full).level[0] for k in range(1, 6)] == [3, 2, 1, 0, 0]


def test_radios_are_known_by_key():
    control = after([0.9, 0.1, 0.45], 60)
    assert sorted(control.key.tolist()) == [3, 5, 7]
    assert control.of(np.array([5, 8, 7], np.uint64)).level.tolist() == [2, 0, 4]  # 8 is new
    assert not gap_ns(control, KEY, DccParams(enabled=False), ON_AIR_NS).any()


def test_faults_are_named():
    with pytest.raises(ValueError, match="cbr_bounds"):
        DccParams(cbr_bounds=(0.5, 0.4, 0.6, 0.7))
    with pytest.raises(ValueError, match="t_off_s"):
        DccParams(t_off_s=(0.1, 0.05, 0.2, 0.3, 1.0))
    with pytest.raises(AssertionError):
        update(DccState.start(), KEY, np.array([0.1, 1.2, 0.3]), DccParams())


ADAPTIVE = DccParams(algorithm="adaptive")


def test_adaptive_control_by_hand():
    """From a share of 0.03 on a channel that is busy for 0.8 of the time.

    Period 2: C = 0.25 (0.8 + 0.8) = 0.4, 0.984 x 0.03 + 0.0012 x 0.28 = 0.029856.
    Period 4: C = 0.2 + 0.4 = 0.6, 0.984 x 0.029856 + 0.0012 x 0.08 = 0.029474304.
    """
    assert after([0.8] * 3, 1, ADAPTIVE).share.tolist() == [0.03] * 3
    assert after([0.8] * 3, 2, ADAPTIVE).share == pytest.approx([0.029856] * 3, rel=1e-12)
    assert after([0.8] * 3, 5, ADAPTIVE).share == pytest.approx([0.029474304] * 3, rel=1e-12)
    # 0.5 ms on air at a share of 0.03: 16.7 ms, raised to 25 ms; 2 ms: 66.7 ms.
    gaps = gap_ns(after([0.0] * 3, 1, ADAPTIVE), KEY, ADAPTIVE, np.array([500_000, 2_000_000, 0]))
    assert gaps.tolist() == [25_000_000, 66_666_667, 25_000_000]


def test_the_time_on_air_of_the_last_message_is_kept_until_the_next_one():
    """Also while others come and go; who has sent nothing yet has none."""
    sent = after([0.0] * 3, 1, ADAPTIVE).after_messages(np.array([500_000, 0, 2_000_000]))
    assert sent.after_messages(np.array([0, 300_000, 0])).airtime_ns.tolist() == [500_000, 300_000, 2_000_000]
    later = update(sent, KEY[1:], np.zeros(2), ADAPTIVE)
    assert later.airtime_ns.tolist() == [0, 2_000_000]
    assert later.of(KEY).airtime_ns.tolist() == [0, 0, 2_000_000]


def test_adaptive_control_converges_to_the_fixed_point_of_limeric():
    """N stations that hear each other and use their whole share: d* = beta target / (alpha + N beta) [2]."""
    n = 60
    key, control = np.arange(n).astype(np.uint64), DccState.start()
    for _ in range(2000):
        busy = np.full(n, min(control.of(key).share.sum(), 1.0))
        control = update(control, key, busy, ADAPTIVE)
    assert control.share == pytest.approx(np.full(n, 0.0012 * 0.68 / (0.016 + n * 0.0012)), rel=1e-6)
