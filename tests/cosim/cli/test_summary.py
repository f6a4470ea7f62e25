"""The summary of a run: a line per topic, numbers first, and what is chance."""

import numpy as np
import pandas as pd
import pytest

from cosim.cli.side_by_side import print_measures, remarks
from cosim.cli.summary import _plot, _summary, print_run_summary
from cosim.config.config import load
from cosim.runs.run import run
from results.archive import open_run
from results.figures.catalogue import FIGURES
from results.measure import measure
from tests.hostile.scenes import street_sets
from tests.results.tiny import fleet, make

NAN = float("nan")


def rows_of(metrics):
    """A function like that of the summary, from value, low, high and note by metric and group."""

    def row(of):
        note = of[1] if len(of) == 2 else ""
        value, low, high = of if len(of) == 3 else (of[0], NAN, NAN)
        return {"value": value, "low": low, "high": high, "note": note}

    return lambda name: {group: row(of) for group, of in metrics.get(name, {}).items()}


METRICS = {
    "traffic.duration_s": {"": (300.0,)},
    "traffic.actors.mean": {"all": (335.4,)},
    "traffic.equipped.n": {"honest": (101.0,), "malicious": (15.0,)},
    "encounters.n": {"equipped, 100 m": (1116.0,), "all, 50 m": (7.0,)},
    "encounters.duration.km_median_s": {"equipped, 100 m": (16.0,)},
    "encounters.duration.km_mean_s": {
        "equipped, 100 m": (24.3,),
        "all, 50 m": (3.0, "57% last longer than 4 s"),
    },
    "trust.final.median": {"honest": (0.78,), "malicious": (0.56,)},
    "misbehaviour.at_lookup.auc": {"unreliable": (0.55, 0.38, 0.71), "malicious": (0.93, 0.88, 0.96)},
    "freshness.lookup_state.share": {"evaluated, all": (0.95,), "stale, all": (0.0,), "no value, all": (0.05,)},
    "freshness.newest_evaluation_age.mean_s": {"all": (4.0,)},
    "freshness.newest_evaluation_age.p90_s": {"all": (5.8,)},
    "radio.pdr.all": {"": (0.6,)},
    "radio.cbr.mean": {"": (0.033,)},
    "radio.pir.mean_s": {"": (1.3,)},
}


def test_every_topic_is_a_line_that_begins_with_a_number():
    said = _summary(rows_of(METRICS), "helsinki", has_sensing=True)
    assert said == {
        "traffic": [
            "335 actors on the road of helsinki for 300 s; 116 vehicles with LiDAR and radio (101 honest, 15 malicious)"
        ],
        "encounters": [
            "1,116 (equipped, 100 m): half of them last longer than 16 s", "7 (all, 50 m): 57% last longer than 4 s"
        ],
        "trust": ["0.78 honest, 0.56 malicious: medians of last values, from 0 to 1"],
        "told apart": [
            "55% of the time an honest vehicle has more trust than an unreliable one (95 % interval 38% to 71%: may "
            "be chance); 93% of the time than a malicious one (88% to 96%), when trust is looked up"
        ],
        "freshness": [
            "4.0 s old on average is the newest evaluation behind a trust value that is used, and one in ten is older "
            "than 5.8 s; 95% of lookups find a value that rests on evaluations that still count"
        ],
        "radio": [
            "60% of frames received by vehicles in range; 3.3% of the time the channel is busy; 1.3 s between messages "
            "of a pair"
        ],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "topic", "says"),
    [
        ({"misbehaviour.at_lookup.auc": {"malicious": (0.5, NAN, NAN)}}, "told apart", "50% of the time an honest"),
        (
            {
                "misbehaviour.at_lookup.auc": {},
                "trust.final.median": {"honest": (0.7,), "malicious": (0.7, "has not attacked")},
            },
            "told apart",
            "no malicious vehicle has attacked: until then they behave as honest ones",
        ),
        (
            {"misbehaviour.at_lookup.auc": {}, "misbehaviour.auc": {"malicious": (0.9, 0.8, 1.0)}},
            "told apart",
            "over the run",
        ),
        ({"trust.final.median": {}}, "trust", "no trust was computed"),
        ({"freshness.lookup_state.share": {}}, "freshness", "no vehicle looked up"),
        ({"radio.pdr.all": {}}, "radio", "nothing was sent"),
        ({"encounters.n": {}}, "encounters", "none: the config defines no"),
        ({"traffic.equipped.n": {"honest": (0.0,)}}, "traffic", "no vehicle with LiDAR and radio"),
        (
            {"traffic.actors.mean": {"all": (1.0,)}, "traffic.equipped.n": {"honest": (1.0,)}},
            "traffic",
            "1 actor on the road of helsinki for 300 s; 1 vehicle with LiDAR",
        ),
        ({"radio.lost.expired": {"": (0.2,)}}, "radio", "20% expired before they could be sent"),
        ({"radio.clouds_complete.share": {"": (0.02,)}}, "radio", "2% of point clouds arrive whole"),
    ],
)
def test_what_is_missing_is_said(changes, topic, says):
    (line,) = _summary(rows_of(METRICS | changes), "helsinki", has_sensing=True)[topic][:1]
    assert says in line


@pytest.mark.parametrize(("n", "said"), [(0.0, ""), (3.0, "   cosim plot encounters RUN")])
def test_no_picture_without_encounters_is_suggested(n, said):
    assert _plot(rows_of({"encounters.n": {"equipped, 100 m": (n,)}}), "RUN") == said


def test_without_sensing_no_other_cause_is_named(tmp_path, capsys):
    """In the summary, in all that is not measured, and in place of figures."""
    keys = [*street_sets(tmp_path), "sensing=false", "fleet.penetration_p=1"]
    folder = run(load(None, keys), tmp_path / "run", lambda *_: None)
    print_run_summary(folder, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    topics = [line.split()[0] for line in lines]
    assert topics[:3] == ["traffic", "encounters", "sensing"] and not {"trust", "radio", "freshness"} & set(topics)
    recorded = open_run(folder)
    table = measure(recorded)
    reasons = table[table.metric.str.endswith(".not_measured")].set_index("metric").group
    assert {"trust.not_measured", "freshness.not_measured", "radio.not_measured"} <= set(reasons.index)
    assert reasons.str.contains("sensing = false, so no vehicle senses or sends").all(), reasons.to_dict()
    for name in ("trust", "misbehaviour", "freshness", "radio", "detection", "ages", "stale"):
        with pytest.raises(ValueError, match="sensing = false, so no vehicle senses or sends"):
            FIGURES[name]([recorded])


def test_a_run_that_is_shorter_than_the_delay_to_the_server_names_the_delay(tmp_path):
    delays = [f"server.cellular.delay_{name}_s=30" for name in ("min", "mean")]
    keys = [*street_sets(tmp_path), *delays]
    recorded = open_run(run(load(None, keys), tmp_path / "run", lambda *_: None))
    (row,) = measure(recorded, topics=("trust",)).itertuples()
    assert row.metric == "trust.not_measured" and "the delays and outages in [server]" in row.group
    # Trust that nobody finds has no age. Of all lookups, none is fresh, and each counts as the window.
    of = {name: recorded.measure.value(f"freshness.{name}", "all") for name in (
        "newest_evaluation_age.mean_s", "evaluation_within.share", "capped_age.mean_s"
    )}  # fmt: skip
    assert list(of.values()) == [pytest.approx(np.nan, nan_ok=True), 0, recorded.config["trust"]["freshness_s"]]


def test_a_run_without_definitions_of_encounters_has_a_summary(tmp_path, capsys):
    keys = [*street_sets(tmp_path), "encounters=[]"]
    folder = run(load(None, keys), tmp_path / "run", lambda *_: None)
    print_run_summary(folder, as_json=False)
    assert "none: the config defines no [[encounters]]" in capsys.readouterr().out


def test_values_side_by_side_say_where_their_intervals_are(tmp_path, capsys):
    """Nothing told a reader that two medians of trust are apart by chance."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    runs = [make(tmp_path / name, 2, vehicles=fleet("honest")) for name in ("a", "b")]
    row = {"metric": "trust.final.median", "group": "honest", "value": 0.7, "low": 0.6, "high": 0.8}
    for low, n_lines in ((0.6, 1), (NAN, 0)):
        print_measures(runs, 2 * [pd.DataFrame([row | {"low": low}])], as_json=False, csv=None)
        assert capsys.readouterr().out.count("have intervals and notes") == n_lines


def test_runs_of_one_config_that_simulated_different_times_are_noted(tmp_path):
    """One ended early. Where the config asks for different times, its key stands above the values."""
    runs = []
    for number, (steps, duration_s) in enumerate(((20, 20.0), (12, 20.0), (12, 12.0))):
        folder = tmp_path / str(number)
        folder.mkdir()
        config = {"traffic": {"duration_s": duration_s}}
        runs.append(make(folder, steps, config, vehicles=fleet("honest")))
    whole, short, other = runs
    (note,) = remarks([whole, short, short])
    assert "simulated 12 and 20 s" in note
    assert not list(remarks([whole, whole])) and not list(remarks([whole, other]))
