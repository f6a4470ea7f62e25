"""Pictures: drawn, labelled with units, saved, the same twice, and never empty."""

import itertools
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from results.archive import open_run
from results.figures import study as study_figure
from results.figures import style, trust
from results.figures.catalogue import FIGURES
from tests.results.synthetic import write
from tests.results.test_study_pages import study_of
from tests.results.tiny import fleet
from tests.slow import slow

X_AXES = {"encounters": "Duration [s]", "freshness": "Age [s]", "radio": "Distance [m]"}
"""Label of the first axis of some figures, with the unit that the dictionary says."""


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """A run in which nothing happened."""
    path = write(tmp_path_factory.mktemp("quiet") / "quiet", steps=10, level="standard")
    for table in ("encounters", "trust", "trust_lookups", "radio", "pdr_by_distance", "actors"):
        for part in (path / table).iterdir():
            part.unlink()
    return path


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.parametrize("n_runs", [slow(1), 2])  # `test_report.py` draws one
def test_every_picture(run, other, name, n_runs, tmp_path):
    figure = FIGURES[name]([run, other][:n_runs])
    for axes in figure.axes:
        if axes.get_label() == "<colorbar>":
            continue
        assert axes.get_title(loc="left"), "every panel has a title"
        assert axes.get_xlabel(), "and a label below"
        assert axes.has_data()
    assert figure.axes[0].get_xlabel() == X_AXES.get(name, figure.axes[0].get_xlabel())
    assert style.save(figure, tmp_path / f"{name}.png").stat().st_size > 5000


def test_messages_of_which_none_is_lost_have_no_curve_of_gaps(tiny):
    gaps = [{"pir_steps": 0, "n_censored": 2}, {"pir_steps": 1, "n_received": 9}]
    sent = {"n_in_range": 11, "n_delivered": 11}
    run = tiny(9, radio=[{"n_sent": 11, **sent}], pdr_by_distance=[sent], packet_inter_reception=gaps)
    panel = FIGURES["radio"]([run, run]).axes[3]
    assert not panel.lines and panel.texts[0].get_text() == "too few messages, or none is lost"


def test_a_single_encounter_is_seen_to_end(tiny):
    meeting = {"a": 0, "b": 1, "start_step": 2, "end_step": 10, "duration_s": 8, "radius_m": 50}
    assert FIGURES["encounters"]([tiny(20, encounters=[meeting])]).axes[0].get_xlim()[1] > 8


def test_too_few_messages_for_a_curve_are_said(tiny):
    sent = {"n_in_range": 4, "n_delivered": 4}
    run = tiny(
        9,
        radio=[{"n_sent": 2, **sent}],
        pdr_by_distance=[sent],
        latency_histogram=[{"latency_s": 0.001, "n_delivered": 4}],
    )
    panels = FIGURES["radio"]([run, run]).axes  # of one run, maps want vehicles
    assert {axes.get_xlim() for axes in panels[4:6]} == {(0.0, 10.0)}  # one window; the axis ended after 0.06 s
    for axes in (panels[0], panels[3]):
        assert not axes.lines and axes.texts[0].get_text().startswith("too few messages")
    under_way = {"a": 0, "b": 1, "start_step": 0, "end_step": 1, "censored_left": True, "radius_m": 50}
    (axes,) = FIGURES["encounters"]([tiny(1, encounters=[under_way])]).axes
    assert [text.get_text() for text in axes.texts] == ["too few encounters"]


def test_ages_that_a_run_did_not_keep_are_not_called_absent(tiny):
    """At level `summary` a run has totals of lookups alone. Here, all find a value that rests on an evaluation."""
    totals = [{"step": 0, "state": "evaluated", "n": 3, "n_valued": 3, "age_sum_s": 2.0}]
    brief = tiny(2, vehicles=fleet("honest"), lookup_totals=totals, trust_lookups=[])
    brief.manifest["dropped"] = ["trust_lookups"]
    with pytest.raises(ValueError, match="no table trust_lookups: it is kept at record"):
        FIGURES["ages"]([brief])
    assert [text.get_text() for text in FIGURES["freshness"]([brief]).axes[0].texts] == ["single lookups were not kept"]


def test_more_runs_than_inks_have_the_colours_of_the_legend(run):
    figure = FIGURES["safety"]([run] * 7)
    drawn = [line.get_color() for line in figure.axes[1].lines]
    assert drawn == [entry.get_color() for entry in figure.legends[0].get_lines()] and len(set(drawn)) == 7


def test_what_cannot_be_drawn_takes_away_nothing_else(run):
    """A run, or a trust variant, without values; if none has any, the first reason is given."""

    def draw(i, _):
        if i != 1:
            raise ValueError(f"number {i}")

    assert style.draw_each([run, run, run], draw) == [0, 2]
    with pytest.raises(ValueError, match="number 0"):
        style.draw_each([run], draw)


@pytest.mark.parametrize("suffix", style.FORMATS)
def test_saved_twice_is_the_same_file(run, suffix, tmp_path):
    one, two = (style.save(trust.draw([run]), tmp_path / f"{n}{suffix}").read_bytes() for n in "ab")
    assert one == two


def test_single_vehicles(run):
    figure = trust.draw([run], vehicles=[0, 12])
    assert {text.get_text() for text in figure.axes[0].texts} >= {"0", "12", "attacks begin"}
    with pytest.raises(ValueError, match="no trust in vehicle 59"):
        trust.draw([run], vehicles=[59])


def test_inks_differ_in_grey():
    grey = [np.dot(to_rgb(ink), (0.299, 0.587, 0.114)) for ink in style.INKS[:4]]
    assert min(np.diff(grey)) > 0.08


def test_36_lines_and_36_markers_differ():
    """The colours of the first six, each with six line styles or markers."""
    for look in (style.dash, style.marker):
        assert len({(style.ink(i), look(i)) for i in range(36)}) == 36


def test_leaves_no_trace(run):
    before = dict(matplotlib.rcParams)
    trust.draw([run])
    assert dict(matplotlib.rcParams) == before


def test_bad_requests(run, tmp_path):
    figure = trust.draw([run])
    with pytest.raises(ValueError, match=r"no picture format. End it in .png, .svg, .pdf"):
        style.save(figure, tmp_path / "trust.bmp")
    assert style.save(figure, tmp_path / "new" / "folder" / "trust.png").is_file()
    with pytest.raises(ValueError, match="no run to draw"):
        trust.draw([])


@pytest.mark.parametrize("name", FIGURES)
def test_nothing_to_draw_is_one_clear_line(name, quiet):
    with pytest.raises(ValueError) as caught:
        FIGURES[name]([open_run(quiet)])
    assert "\n" not in str(caught.value)


def test_runs_of_one_name_are_told_apart(run, tmp_path):
    folders = [tmp_path / place / "same" for place in ("one", "two")]
    for folder in folders:
        folder.mkdir(parents=True)
    twins = [open_run(write(folder / run.name, steps=10)) for folder in folders]
    assert style.names(twins) == [f"one/same/{run.name}", f"two/same/{run.name}"]
    of_variants, labels = style.variants_of([run, *twins])
    assert len(set(labels)) == len(of_variants) == 3


def test_runs_of_a_study_are_called_by_the_keys_that_differ():
    """Their folders have codes for names. Runs that a user named keep these names."""
    values = [(5, 5), (5, 12), (9, 12)]

    def named(names):
        configs = [{"attacks": [{"start_s": start_s}], "trust": {"freshness_s": s}} for start_s, s in values]
        both = zip(names, configs, strict=True)
        return [SimpleNamespace(name=name, config=of, variant="base", path=Path(name)) for name, of in both]

    said = [f"start_s = {start_s}, freshness_s = {s}" for start_s, s in values]
    assert style.names(named(f"{number:016x}" for number in range(3))) == said
    assert style.names(named("abc")) == ["a", "b", "c"]


def test_malicious_is_red_and_every_role_has_one_colour(run):
    roles = run.role_labels
    red, green, blue = to_rgb(style.role_look("malicious", roles)["color"])
    assert red > 0.7 and green < 0.4 and blue < 0.4
    assert len({style.role_look(role, (*roles, "mine", "yours"))["color"] for role in (*roles, "mine", "yours")}) == 5
    shown = {line.get_label(): line.get_color() for line in trust.draw([run]).legends[0].get_lines()}
    assert shown == {role: style.role_look(role, roles)["color"] for role in roles}


def test_heat_map_of_attacks_and_models(tmp_path):
    """Seeds at 0.4, 0.5 and 0.6: error 0.0577, and 4.303 for two degrees of freedom; expit(+-4.303 x 0.0577 / 0.25).

    The last cell has two seeds, 0.4 and 0.5, and no interval.
    """

    def value(metric, keys, replicate):
        is_missing = (keys["attack"], keys["model"], replicate) == ("replay", "mate", 2)
        return np.nan if is_missing else 0.4 + 0.1 * replicate

    swept = {"attack": ("ghosts", "replay"), "model": ("beta", "mate")}
    study = study_of(tmp_path, swept, value=value, measured=[("misbehaviour.auc", "malicious")])
    axes = study_figure.draw(study, "misbehaviour", ["misbehaviour.auc:malicious"]).axes[0]
    assert [text.get_text() for text in axes.texts] == [".50", ".50", ".50", ".45"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["beta", "mate"]
    assert "2 to 3 seeds, 95 % intervals up to ±.23" in axes.get_title(loc="left").replace("\n", " ")


@pytest.mark.parametrize(("metric", "top"), [("evidence.fused.multiplicity", 3.5), ("misbehaviour.auc", 0.8)])
def test_every_mean_is_within_the_axis_and_the_scale(metric, top, tmp_path):
    """Multiplicity has the unit 1 and is no share: it may be 3.5."""
    drawn = []
    for what, levels in (("map", ("beta", "mate")), ("lines", (10.0, 50.0))):
        swept, values = {"attack": ("ghosts", "replay"), "level": levels}, iter(np.linspace(top / 2, top, 4))
        study = study_of(tmp_path / what, swept, 1, lambda *_, values=values: next(values), measured=[(metric, "")])
        figure = study_figure.draw(study, metric.partition(".")[0], [metric])
        drawn.append(figure.axes[0])
    assert drawn[0].images[0].get_clim() == (0, max(top, 1))
    assert top <= drawn[1].get_ylim()[1] < 1.1 * top


@pytest.mark.parametrize("seeds", [1, 3])
def test_negative_means_are_within_the_axis_and_the_scale(seeds, tmp_path):
    """A metric of one's own, such as a utility: the axis ended below the largest mean, and the map was refused."""
    for what, levels in (("map", ("beta", "mate")), ("lines", (10.0, 50.0))):
        swept, values = (
            {"attack": ("ghosts", "replay"), "level": levels},
            itertools.cycle(np.linspace(-6.0, -5.0, 4 * seeds)),
        )
        study = study_of(tmp_path / what, swept, seeds, lambda *_, v=values: next(v), measured=[("security.mcc", "")])
        study.measures = study.measures.assign(metric="own.utility", unit="")
        (axes,) = study_figure.draw(study, "", ["own.utility"]).axes
        if what == "map":
            assert axes.images[0].get_clim() == (study.summary["mean"].min(), 0)
        else:
            low, high = axes.get_ylim()
            assert low < study.summary["mean"].min() and high == 0


def test_a_correlation_of_less_than_none_has_a_colour_of_its_own(tmp_path):
    swept, values = {"attack": ("ghosts", "replay"), "trust.model": ("beta", "mate")}, iter([-0.8, -0.2, 0.0, 0.4])
    study = study_of(tmp_path, swept, 1, lambda *_: next(values), measured=[("security.mcc", "value")])
    (axes,) = study_figure.draw(study, "security", ["security.mcc:value"]).axes
    assert axes.images[0].get_clim() == (-1, 1)


MODELS = tuple(f"model_with_a_long_name_{i}" for i in range(12))


def test_many_lines_leave_room_for_their_panel(tmp_path):
    """A legend of twelve rows took nearly all of the sheet."""
    swept = {"trust.model": MODELS, "fleet.penetration_p": (0.1, 0.3, 0.5, 0.7)}
    study = study_of(tmp_path, swept, 1, lambda *_: 0.7, measured=[("misbehaviour.auc", "malicious")])
    figure = study_figure.draw(study, "", ["misbehaviour.auc:malicious"])
    assert figure.axes[0].get_window_extent().height / style.DPI > 1.3
    over = study_figure.draw(study, "", ["misbehaviour.auc:malicious"], over="trust.model").axes[0]
    at = np.sort([x for line in over.get_lines()[:4] for x in line.get_xdata()]).reshape(12, 4)
    assert np.ptp(at, axis=1).max() < 0.5 < np.diff(at.mean(axis=1)).min(), "nearer to their word than to the next"


def test_runs_with_long_names_leave_room_for_their_panels(run, tmp_path):
    """The names of four rows left an eighth of the width to the bars."""
    for i in range(4):
        (tmp_path / f"{MODELS[0]}_and_something_more_{i}").symlink_to(run.path)
    runs = [open_run(path) for path in sorted(tmp_path.iterdir())]
    bars = FIGURES["freshness"](runs).axes[1]
    assert bars.get_window_extent().width / style.DPI > 0.5 * style.WIDTH
    names = [label.get_text() for label in bars.get_yticklabels()]
    assert len(set(names)) == 4 and max(map(len, names)) <= 20


def test_numbers_under_an_axis_do_not_stand_on_one_another(tmp_path):
    swept = {"attacks.0.share_p": (0.0, 0.001, 0.1, 0.5)}
    study = study_of(tmp_path, swept, 1, lambda *_: 0.7, measured=[("trust.final.median", "honest")])
    (axes,) = study_figure.draw(study, "trust").axes
    assert axes.get_xticks().tolist() == [0.0, 0.001, 0.1, 0.5]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0", "", "0.1", "0.5"]


def test_many_numbers_under_a_logarithmic_axis_do_not_stand_on_one_another(tmp_path):
    study = study_of(
        tmp_path,
        {"attacks.0.share_p": [k / 50 for k in range(1, 31)]},
        1,
        lambda *_: 0.7,
        measured=[("trust.final.median", "honest")],
    )
    figure = study_figure.draw(study, "trust")
    figure.canvas.draw()
    assert figure.axes[0].get_xscale() == "log"
    boxes = [text.get_window_extent() for text in figure.axes[0].get_xticklabels() if text.get_text()]
    assert len(boxes) > 3 and not any(one.overlaps(other) for one, other in itertools.pairwise(boxes))


def test_words_under_two_axes_do_not_stand_on_one_another(tmp_path):
    swept = {"trust.model": ("beta", "trupercept", "mate", "minhas"), "fleet.penetration_p": (0.1, 0.3)}
    swept |= {"trust.freshness_s": (2.0, 10.0)}
    study = study_of(tmp_path, swept, 1, lambda *_: 0.7, measured=[("trust.final.median", "honest")])
    figure = study_figure.draw(study, "trust", over="trust.model")
    assert len(figure.axes) == 2
    for axes in figure.axes:
        assert {label.get_rotation() for label in axes.get_xticklabels()} == {30}


def test_ages_are_drawn_up_to_the_largest(tiny):
    """Nine of ten lookups find an age of 2 s, and one finds 7 s: a tenth is older than 2 s, up to 7 s."""
    seen = {"receiver": 0, "source": "server", "state": "evaluated", "n_evaluations": 3, "age_s": 2.0}
    ages = {"oldest_evaluation_age_s": 2.0}
    lookups = [
        seen | ages | {"step": s, "subject": 1, "newest_evaluation_age_s": 7.0 if s == 4 else 2.0} for s in range(10)
    ]
    run = tiny(10, vehicles=fleet("honest", "honest"), trust_lookups=lookups)
    (axes,) = FIGURES["ages"]([run]).axes
    value, newest, _ = axes.get_lines()
    assert newest.get_xydata()[1:].tolist() == [[2.0, pytest.approx(0.1)], [7.0, pytest.approx(0.1)]]
    assert axes.get_xlim()[1] > 7 and value.get_markevery() is None, "a single age is a mark"


def test_the_ideal_observer_is_the_first_row_of_a_heat_map_of_models(tmp_path):
    """One bound per attack, the same for both models; a metric without a bound has no such row."""
    swept = {"attack": ("ghosts", "replay"), "trust.model": ("beta", "mate")}
    values = iter([0.2, 0.9, 0.1, 0.3, 0.9, 0.1, 0.4, 0.8, 0.1, 0.5, 0.8, 0.1])
    names = ("misbehaviour.auc", "evidence.auc_bound", "misbehaviour.recall_at_fpr")
    measured = [(name, "malicious") for name in names]
    study = study_of(tmp_path, swept, 1, lambda *_: next(values), measured=measured)
    asked = ["misbehaviour.auc:malicious", "misbehaviour.recall_at_fpr:malicious"]
    first, second, *_ = study_figure.draw(study, "misbehaviour", asked).axes
    assert [text.get_text() for text in first.texts] == [".90", ".80", ".20", ".40", ".30", ".50"]
    assert [label.get_text() for label in first.get_yticklabels()] == ["ideal observer", "beta", "mate"]
    assert [label.get_text() for label in second.get_yticklabels()] == ["beta", "mate"]


def test_encounters_of_a_study_over_radius_and_kind_of_pairs(tmp_path):
    """The groups of encounter metrics are keys: two radii on the axis, two kinds of pairs as lines."""
    groups = [f"{pairs}, {radius} m" for pairs in ("equipped", "los") for radius in (50, 100)]
    measured, values = (
        [("encounters.duration.km_median_s", group) for group in groups],
        itertools.cycle([8.0, 16.0, 7.0, 12.0]),
    )
    study = study_of(tmp_path, {"traffic.scale": (0.5, 1.0)}, 1, lambda *_: next(values), measured=measured)
    panels = study_figure.draw(study, "encounters", over="radius_m", by="pairs").axes
    assert len(panels) == 2
    for axes in panels:
        drawn = [line.get_ydata().tolist() for line in axes.get_lines()]
        assert [8.0, 16.0] in drawn and [7.0, 12.0] in drawn
