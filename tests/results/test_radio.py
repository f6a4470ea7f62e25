"""Figures of the radio, by hand."""

import pytest

from results.figures.catalogue import FIGURES
from results.measure import measure
from results.metrics import radio

CONFIG = {
    "radio": {
        "model": "csma", "range_m": 300.0,
        "propagation": {
            "model": "urban", "walls": "3gpp", "fading": "nakagami", "wall_db": 9.0, "indoors_db_per_m": 0.4,
        },
        "receiver": {"p_min_dbm": -92.0, "sinr_min_db": 4.0}, "dcc": {"enabled": True}, "relay": {"max_hops": 2},
        "unit_disk": {"loss_p": 0.05},
    },
    "fleet": {"penetration_p": 0.35, "equipped_kinds": ["car", "van"]},
}  # fmt: skip


def test_inter_reception_by_kaplan_meier(tiny):
    """Eight silences of one step, one of two, one of four; one pair parts unheard after two steps."""
    rows = [
        {"step": 4, "gap_steps": 1, "n_received": 8}, {"step": 4, "gap_steps": 2, "n_received": 1, "n_parted": 1},
        {"step": 5, "gap_steps": 4, "n_received": 1}, {"step": 5, "gap_steps": 0, "n_parted": 3},
    ]  # fmt: skip
    run = tiny(6, silences=rows)
    gaps = radio.inter_reception(run).set_index("gap_s")
    # At risk: 11 of one step, 3 of two, 1 of four: survival 3/11, times 2/3, times 0.
    assert gaps.longer.loc[[0.0, 1.0, 2.0, 4.0]].tolist() == pytest.approx([1, 3 / 11, 2 / 11, 0])
    assert gaps.n_lost.tolist() == [0, 0, 1, 3]
    with pytest.raises(ValueError, match="no two verdicts in a row"):
        radio.inter_reception(run, "verdicts")


def test_latency_adds_up(tiny):
    rows = [
        {"step": s, "latency_s": low, "n_delivered": n} for s, low, n in ((0, 0.001, 3), (0, 0.002, 1), (1, 0.001, 4))
    ]
    found = radio.latency(tiny(2, latencies=rows))
    assert found.n_delivered.tolist() == [7, 1]
    assert found.share.tolist() == [7 / 8, 1]
    assert found.latency_s.tolist() == pytest.approx([0.001 * 2**0.5, 0.002 * 2**0.5])  # upper edges


def test_delivery_by_what_stands_between(tiny):
    links = [
        {"ring_m": ring, "view": view, "n_in_reach": 10, "n_delivered": n}
        for ring, view, n in ((0, "open", 10), (0, "wall", 5), (25, "open", 8), (25, "wall", 1))
    ]
    run = tiny(1, links=links)
    assert radio.by_distance(run).delivery_ratio.tolist() == [0.75, 0.45]
    by_view = radio.by_distance(run, by_view=True)
    assert by_view.view.tolist() == ["open", "open", "wall", "wall"]
    assert by_view.delivery_ratio.tolist() == [1, 0.8, 0.5, 0.1]
    assert by_view.distance_m.tolist() == [12.5, 37.5] * 2


def test_the_map(tiny):
    actors = [
        {"step": s, "actor": a, "x_m": x, "y_m": 10} for s, a, x in ((0, 0, 5), (0, 1, 60), (1, 0, 55), (1, 1, 95))
    ]
    ears = [
        {"step": s, "vehicle": v, "busy_ratio": b, "n_in_reach": 4, "n_heard": n}
        for s, v, b, n in ((0, 0, 0.25, 4), (0, 1, 0.5, 2), (1, 0, 0.0, 0), (1, 1, 0.25, 1))
    ]
    cells = radio.by_place(tiny(2, actors=actors, ears=ears), 50.0)
    assert cells[["x_m", "y_m", "n"]].values.tolist() == [[25, 25, 1], [75, 25, 3]]
    assert cells.busy_ratio.tolist() == [0.25, 0.25]
    assert cells.delivery_ratio.tolist() == [1, 0.25]


def test_the_way_to_the_server(tiny):
    rows = [
        {"step": s, "n_reports": 10, "n_reached": 10 - 2 * s, "n_lost": s, "n_outage": s, "n_addressed": 10 * s,
         "n_informed": 9 * s} for s in (0, 1)
    ]  # fmt: skip
    (way,) = radio.to_server(tiny(2, server=rows)).itertuples()
    assert (way.n_reports, way.reached, way.lost, way.outage, way.informed) == (20, 0.9, 0.05, 0.05, 0.9)


def test_conditions_stand_beside_the_figures(tiny):
    radios = [{"n_sent": 2, "n_in_reach": 4, "n_delivered": 3, "n_lost_propagation": 1, "busy_ratio": 0.1}]
    links = [{"n_in_reach": 4, "n_delivered": 3}]
    run = tiny(1, CONFIG, radio=radios, links=links, latencies=[{"latency_s": 0.001, "n_delivered": 3}],
               silences=[{"gap_steps": 1, "n_received": 2}])  # fmt: skip
    said = radio.conditions(run).set_index("condition")
    assert said.value["receiver threshold"] == -92 and said.value["penetration"] == 0.35
    assert said["is"]["non-line-of-sight model"] == "TR 37.885 NLOS"
    assert said["is"]["fading"].startswith("Nakagami") and said["is"]["congestion control"] == "reactive"
    measured = measure(run)
    figures = measured[measured.topic == "radio"].figure.tolist()
    assert figures.index("receiver threshold") < figures.index("delivery ratio")
    assert {"inter-reception time", "latency at most", "busy ratio", "penetration", "fading"} <= set(figures)
    disk = tiny_disk(run)
    assert set(disk["is"][["receiver threshold", "non-line-of-sight model", "fading"]]) == {"none: disk"}


def tiny_disk(run):
    """Conditions of the same run with the other model."""
    run.manifest["config"] = {**CONFIG, "radio": {**CONFIG["radio"], "model": "unit_disk"}}
    return radio.conditions(run).set_index("condition")


def test_two_pictures(run, other):
    alone = FIGURES["radio"]([run])
    titles = [axes.get_title(loc="left") for axes in alone.axes]
    assert {
        "Delivered, by distance", "Latency of what arrived", "Between two messages", "Channel busy, over time",
        "Channel busy, on the map",
    } <= set(titles)  # fmt: skip
    beside = FIGURES["radio"]([run, other])
    assert "Channel busy, on the map" not in [axes.get_title(loc="left") for axes in beside.axes]
