"""Metrics of the radio, by hand."""

import numpy as np
import pytest

from results.figures.catalogue import FIGURES
from results.metrics import radio
from results.metrics.lookups import no_lookups
from tests.results.tiny import make


def test_inter_reception_by_kaplan_meier(tiny):
    """Eight intervals of one step, one of two, one of four; one pair gets out of range after two steps."""
    rows = [
        {"step": 4, "pir_steps": 1, "n_received": 8}, {"step": 4, "pir_steps": 2, "n_received": 1, "n_censored": 1},
        {"step": 5, "pir_steps": 4, "n_received": 1}, {"step": 5, "pir_steps": 0, "n_censored": 3},
    ]  # fmt: skip
    run = tiny(6, packet_inter_reception=rows)
    gaps = radio.inter_reception(run).set_index("pir_s")
    # At risk: 11 of one step, 3 of two, 1 of four: survival 3/11, times 2/3, times 0.
    assert gaps.longer.loc[[0.0, 1.0, 2.0, 4.0]].tolist() == pytest.approx([1, 3 / 11, 2 / 11, 0])
    assert gaps.n_lost.tolist() == [0, 0, 1, 3]
    with pytest.raises(ValueError, match="no two messages of type evaluation in a row"):
        radio.inter_reception(run, "evaluation")


def test_losses_are_counted_where_all_vehicles_sense_at_one_interval(tmp_path):
    """Of ten intervals, one has a loss. With groups or generation rules, its vehicle may have had nothing to send."""
    rows = [{"step": 1, "pir_steps": 1, "n_received": 9}, {"step": 2, "pir_steps": 2, "n_received": 1}]
    groups = {"sensing_groups": [{"share_p": 0.5, "interval_s": 2.0}]}
    configs = {"one": {"cpm": {"rules": "all"}}, "several": groups, "etsi": {"cpm": {"rules": "etsi"}}}
    for name in configs:
        (tmp_path / name).mkdir()
    one, *others = (make(tmp_path / name, 3, config, packet_inter_reception=rows) for name, config in configs.items())
    (found,) = radio.inter_reception_means(one).itertuples()
    assert (found.mean_s, found.after_loss, found.n_lost) == pytest.approx((1.1, 0.1, 1.0))
    for run in others:
        (found,) = radio.inter_reception_means(run).itertuples()
        assert found.mean_s == pytest.approx(1.1) and found[2:] == pytest.approx((np.nan, np.nan), nan_ok=True)
        assert radio.inter_reception(run).n_lost.isna().all()


def test_latency_adds_up(tiny):
    rows = [
        {"step": s, "latency_s": low, "n_delivered": n}
        for s, low, n in ((0, 0.0008, 3), (0, 0.0016, 1), (1, 0.0008, 4))
    ]
    found = radio.latency(tiny(2, latency_histogram=rows))
    assert found.n_delivered.tolist() == [7, 1]
    assert found.share.tolist() == [7 / 8, 1]
    assert found.latency_s.tolist() == pytest.approx([0.0008 * 2**0.5, 0.0016 * 2**0.5])  # upper edges


def test_delivery_by_what_stands_between(tiny):
    pdr = [
        {"distance_bin_m": ring, "los_state": state, "n_in_range": 10, "n_delivered": n}
        for ring, state, n in ((0, "los", 10), (0, "nlos", 5), (25, "los", 8), (25, "nlos", 1))
    ]
    run = tiny(1, pdr_by_distance=pdr)
    assert radio.by_distance(run).pdr.tolist() == [0.75, 0.45]
    by_los = radio.by_distance(run, by_los=True)
    assert by_los.los_state.tolist() == ["los", "los", "nlos", "nlos"]
    assert by_los.pdr.tolist() == [1, 0.8, 0.5, 0.1]
    assert by_los.distance_m.tolist() == [12.5, 37.5] * 2


@pytest.mark.parametrize(
    ("model", "row", "why"),
    [
        ("unit_disk", {"n_in_range": 8, "n_lost_propagation": 8}, "all 8 frames within range were lost. Lower radio.u"),
        ("csma", {"n_in_range": 8, "n_lost_collision": 8}, "all 8 frames within range were lost. The metrics radio.lo"),
        ("csma", {}, "no vehicle had another in range"),
    ],
)
def test_nothing_received_names_its_cause(tiny, model, row, why):
    run = tiny(1, radio=[row], latency_histogram=[], packet_inter_reception=[])
    run.manifest["config"]["radio"] = {"model": model}
    with pytest.raises(ValueError, match=why):
        radio.latency(run)
    with pytest.raises(ValueError, match=why):
        radio.inter_reception(run)
    assert why in str(no_lookups(run))


def test_the_map(tiny):
    actors = [
        {"step": s, "actor": a, "x_m": x, "y_m": 10} for s, a, x in ((0, 0, 5), (0, 1, 60), (1, 0, 55), (1, 1, 95))
    ]
    channel = [
        {"step": s, "vehicle": v, "cbr": b, "n_in_range": 4, "n_received": n}
        for s, v, b, n in ((0, 0, 0.25, 4), (0, 1, 0.5, 2), (1, 0, 0.0, 0), (1, 1, 0.25, 1))
    ]
    run = tiny(2, actors=actors, vehicle_channel=channel)
    cells = radio.by_place(run, 50.0)
    assert cells[["x_m", "y_m", "n"]].values.tolist() == [[25, 25, 1], [75, 25, 3]]
    assert cells.cbr.tolist() == [0.25, 0.25]
    assert cells.pdr.tolist() == [1, 0.25]
    run.manifest["config"]["radio"] = {"relay": {"max_hops": 3}}
    with_relays = radio.by_place(run, 50.0)
    assert with_relays.pdr.isna().all() and with_relays.cbr.tolist() == [0.25, 0.25]


def test_the_way_to_the_server(tiny):
    lost = {"n_reached": -3, "n_lost": 2, "n_late": 1, "n_outage": 1, "n_addressed": 10, "n_informed": 9}
    rows = [{"step": 0, "n_reports": 10} | dict.fromkeys(lost, 0) | {"n_reached": 10}]
    rows.append({"step": 1, "n_reports": 10} | lost | {"n_reached": 10 - 3})
    (way,) = radio.to_server(tiny(2, server=rows)).itertuples()
    assert (way.n_reports, way.reached, way.lost, way.outage, way.informed) == (20, 0.9, 0.05, 0.05, 0.9)


def test_two_pictures(run, other):
    alone = FIGURES["radio"]([run])
    titles = [axes.get_title(loc="left") for axes in alone.axes]
    assert {
        "Delivery by distance", "Latency", "Packet inter-reception", "Channel busy ratio",
        "Messages lost",
    } <= set(titles)  # fmt: skip
    beside = FIGURES["radio"]([run, other])
    assert "Messages lost" not in [axes.get_title(loc="left") for axes in beside.axes]
