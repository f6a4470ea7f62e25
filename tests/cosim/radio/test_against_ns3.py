"""The event loop against ns-3.44 at the same positions and link losses; nothing is tuned per curve."""

import numpy as np
import pandas as pd
import pytest

from cosim.radio.channel import AccessParams, ChannelRules, ChannelState, Packets, PhyOutcome, run_window
from cosim.radio.phy import ReceiverParams
from tests.cosim.radio import ns3

MODELS = ("friis", "tworay", "logd")
verify = pytest.mark.verify


def single(model: str, nak: int, payload: int, p_min_dbm: int, n_packets: int) -> None:
    curve = pd.read_csv(ns3.file("single_pdr.csv")).query(
        f"model == '{model}' and nak == {nak} and payload == {payload} and minrssi == {p_min_dbm}"
    )
    if curve.empty:
        pytest.skip("no such curve in the reference data")
    xyz = np.column_stack([np.r_[0, 2.5 + 5 * np.arange(160)], np.zeros(161), np.full(161, 1.5)])
    net = ns3.links(xyz, ns3.loss_db(model, xyz), bool(nak))
    rows, ones = np.arange(n_packets), np.ones(n_packets, np.int64)
    packets = Packets(
        0 * ones, rows.astype(np.uint64), rows * 10_000_000, payload * ones, np.full(n_packets, 2, np.uint8),
        ns3.PERIOD_NS * ones, rows,
    )  # fmt: skip
    _, out = run_window(
        ChannelState.start(),
        net,
        packets,
        n_packets * 10_000_000,
        ChannelRules(np.uint64(1), ReceiverParams(p_min_dbm=p_min_dbm), ns3.DCF),
    )
    heard = np.bincount(out.receiver[out.reception == PhyOutcome.RECEIVED], minlength=161)[1:] / n_packets
    # 32 bins of 5 receivers; the reference has a standard error of up to 0.002 there.
    assert np.abs(heard.reshape(32, 5).mean(1) - curve.pdr.to_numpy()).max() <= 0.01


@pytest.mark.parametrize("p_min_dbm", [-82, -110])
def test_a_single_sender_is_heard_as_far_as_in_ns3(p_min_dbm):
    single("logd", 1, 300, p_min_dbm, 5000)


@verify
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("nak", [0, 1])
@pytest.mark.parametrize("payload", [300, 800])
@pytest.mark.parametrize("p_min_dbm", [-82, -110])
def test_single_sender(model, nak, payload, p_min_dbm):
    single(model, nak, payload, p_min_dbm, 40_000)


def load(model: str, nak: int, n: int, p_min_dbm: int) -> None:
    which = f"model == '{model}' and nak == {nak} and N == {n} and minrssi == {p_min_dbm}"
    curve = pd.read_csv(ns3.file("load_pdr.csv")).query(which)
    if curve.empty:
        pytest.skip("no such curve in the reference data")
    about = pd.read_csv(ns3.file("load_summary.csv")).query(which).iloc[0]
    heard, chances, busy, strong, latency = 0.0, 0.0, [], [], []
    for seed in range(1, 6):
        xyz = ns3.positions("pos", n, seed)
        runs = ns3.measure(
            xyz, ns3.loss_db(model, xyz), bool(nak), ReceiverParams(p_min_dbm=p_min_dbm), ns3.DCF, 5, 45, seed
        )
        h, c = ns3.binned(xyz, runs, None, 800)
        heard, chances = heard + h, chances + c
        busy.append(runs.busy)
        strong.append(runs.busy_strong)
        latency.append(runs.latency_s)
    error = heard / chances - curve.pdr.to_numpy()
    overload = about.cbr_phy > 0.70
    assert np.sqrt(np.mean(error**2)) <= (0.025 if overload else 0.015)
    assert np.abs(error).max() <= (0.045 if overload else 0.03)
    assert np.mean(busy) == pytest.approx(about.cbr_phy, abs=0.02)
    assert np.mean(strong) == pytest.approx(about.cbr85, abs=0.02)
    if not overload:
        ms = 1e3 * np.concatenate(latency)
        assert ms.mean() == pytest.approx(about.lat_mean_ms, rel=0.10)
        assert np.quantile(ms, 0.95) == pytest.approx(about.lat_p95_ms, rel=0.20)


@pytest.mark.parametrize("p_min_dbm", [-82, -110])
def test_a_highway_under_load_delivers_as_in_ns3(p_min_dbm):
    load("friis", 1, 100, p_min_dbm)


@verify
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("nak", [0, 1])
@pytest.mark.parametrize("n", [100, 200, 400])
@pytest.mark.parametrize("p_min_dbm", [-82, -110])
def test_load(model, nak, n, p_min_dbm):
    load(model, nak, n, p_min_dbm)


def urban(n: int, p_min_dbm: int, seeds: range) -> None:
    curves = pd.read_csv(ns3.file("urban_pdr.csv")).query(f"N == {n} and minrssi == {p_min_dbm} and n >= 2000")
    if curves.empty:
        pytest.skip("no such curve in the reference data")
    about = pd.read_csv(ns3.file("urban_summary.csv")).query(f"N == {n} and minrssi == {p_min_dbm}").iloc[0]
    tally = {"LOS": [0.0, 0.0], "NLOS": [0.0, 0.0]}
    busy = []
    for seed in seeds:
        xyz = ns3.positions("urb", n, seed)
        loss, nlos, upper = np.zeros((n, n)), np.zeros((n, n), bool), np.triu_indices(n, 1)
        with np.load(ns3.file(f"positions/urb_{n}_{seed}_links.npz")) as given:
            loss[upper], nlos[upper] = given["path_loss_db"], given["nlos"]
        loss, nlos = loss + loss.T, nlos | nlos.T
        runs = ns3.measure(xyz, loss, True, ReceiverParams(p_min_dbm=p_min_dbm), ns3.DCF, 5, 35, seed)
        busy.append(runs.busy)
        for name, among in (("LOS", ~nlos), ("NLOS", nlos)):
            for k, part in enumerate(ns3.binned(xyz, runs, among, 1500)):
                tally[name][k] = tally[name][k] + part
    for name, (heard, chances) in tally.items():
        curve = curves[curves["class"] == name]
        at = (curve.bin_lo // ns3.BIN_M).to_numpy(int)
        error = heard[at] / chances[at] - curve.pdr.to_numpy()
        assert np.sqrt(np.mean(error**2)) <= 0.01, name
        assert np.abs(error).max() <= 0.02, name
    assert np.mean(busy) == pytest.approx(about.cbr_phy, abs=0.02)


def test_a_city_with_hidden_senders_delivers_as_in_ns3():
    urban(400, -110, range(1, 4))


@verify
@pytest.mark.parametrize("n", [400, 800])
@pytest.mark.parametrize("p_min_dbm", [-82, -110])
def test_urban(n, p_min_dbm):
    urban(n, p_min_dbm, range(1, 4))


VARIANTS = {
    "aifsn6": (ReceiverParams(p_min_dbm=-110), AccessParams(aifsn=(6,) * 4, cw=(15,) * 4), {}),
    "nist": (ReceiverParams(p_min_dbm=-110, error_model="nist"), ns3.DCF, {}),
    "p800": (ReceiverParams(p_min_dbm=-110), ns3.DCF, {"payload_bytes": 800}),
    "fixedphase": (ReceiverParams(p_min_dbm=-110), ns3.DCF, {"fixed_phase": True}),
    "capture16us": (ReceiverParams(p_min_dbm=-110, capture=True), ns3.DCF, {}),
}


@verify
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("n", [200, 400])
def test_variant(variant, n):
    curve = pd.read_csv(ns3.file("variants_pdr.csv")).query(f"variant == '{variant}' and N == {n}")
    if curve.empty:
        pytest.skip("no such curve in the reference data")
    receiver, access, how = VARIANTS[variant]
    given = (ns3.HERE / f"positions/pos_{n}_1.txt").exists()  # else drawn as they were, so more of them
    heard, chances = 0.0, 0.0
    for seed in range(1, 4 if given else 13):
        xyz = ns3.positions("pos", n, seed) if given else ns3.highway(n, seed)
        runs = ns3.measure(xyz, ns3.loss_db("logd", xyz), True, receiver, access, 5, 35, seed, **how)
        h, c = ns3.binned(xyz, runs, None, 800)
        heard, chances = heard + h, chances + c
    assert np.abs(heard / chances - curve.pdr.to_numpy()).max() <= 0.03
