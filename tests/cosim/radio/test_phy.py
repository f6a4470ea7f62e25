import numpy as np
import pandas as pd
import pytest

from cosim.radio.phy import BITS_PER_SYMBOL, CURVES, ReceiverParams, airtime_ns
from tests.cosim.radio import ns3


def packet_success(sinr_db, mpdu_bytes, params):
    """Probability that a detected frame is free of errors: see `CURVES`."""
    x0, w = CURVES[params.error_model][params.rate_mbps]
    with np.errstate(over="ignore"):
        return np.exp(-mpdu_bytes / 336.0 * np.exp((x0 - sinr_db) / w))


def test_noise_of_ten_megahertz():
    # k 290 K 10 MHz = 4.004e-11 mW = -103.98 dBm; noise figure 7 dB.
    assert ReceiverParams().noise_dbm == pytest.approx(-96.98, abs=0.01)


def test_the_stronger_of_threshold_and_preamble_sinr_decides():
    assert ReceiverParams(p_min_dbm=-82).detectable_dbm == -82
    assert ReceiverParams(p_min_dbm=-110).detectable_dbm == pytest.approx(-92.98, abs=0.01)


def test_airtime_by_hand():
    # 300 B: MPDU 336 B = 2688 bits, +22 = 2710, / 48 = 56.5 -> 57 symbols of 8 us, +40 us = 496 us.
    assert airtime_ns(np.array([100, 200, 300, 500, 800, 1000, 1400]), 6.0).tolist() == [
        232_000, 360_000, 496_000, 760_000, 1_160_000, 1_432_000, 1_960_000
    ]  # fmt: skip


@pytest.mark.parametrize("model", ["table", "nist"])
@pytest.mark.parametrize("rate", BITS_PER_SYMBOL)
def test_success_curves_are_those_of_ns3(model, rate):
    curves = pd.read_csv(ns3.file("per_curves_ns3.csv.gz"))
    name = {"table": "TableBasedErrorRateModel", "nist": "NistErrorRateModel"}[model]
    curve = curves[(curves.model == name) & (curves.rate_mbps == rate) & (curves.mpdu_bytes == 336)]
    params = ReceiverParams(rate_mbps=rate, error_model=model)
    error = packet_success(curve.snr_db.to_numpy(), 336.0, params) - curve.psr.to_numpy()
    assert np.abs(error).max() <= {"table": 0.11, "nist": 0.016}[model]
    # Where half the frames are lost, to 0.13 dB.
    grid = np.linspace(-5, 30, 7001)
    half = grid[np.searchsorted(packet_success(grid, 336.0, params), 0.5)]
    assert half == pytest.approx(np.interp(0.5, curve.psr, curve.snr_db), abs=0.13)


def test_longer_or_weaker_is_never_better():
    params, sinr = ReceiverParams(), np.linspace(-5, 30, 100)
    short, long = packet_success(sinr, 136.0, params), packet_success(sinr, 1436.0, params)
    assert np.all(long <= short)
    assert np.all(np.diff(short) >= 0)


def test_faults_are_named():
    with pytest.raises(ValueError, match="rate_mbps = 5"):
        ReceiverParams(rate_mbps=5.0)
    with pytest.raises(ValueError, match="floor_dbm"):
        ReceiverParams(floor_dbm=-80.0)
    with pytest.raises(ValueError, match="Segment the message"):
        airtime_ns(np.array([4000]), 6.0)
