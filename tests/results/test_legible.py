"""Every picture at a width of 8 cm: nothing is cut off, overlaps, or is too small. All that ship are of this style."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.colors import to_rgb
from matplotlib.text import Text
from PIL import Image

from cosim.addons.compare import figure as compared
from cosim.addons.law import figure as law
from cosim.addons.pictures import scene_figure, sweep_figure
from cosim.addons.pictures.movie_figure import DPI
from results.figures import city, study, style
from results.figures.catalogue import FIGURES
from tests.results import tiny
from tests.results.test_misbehaviour import attacking
from tests.results.test_study_pages import study_of

WIDTH_CM = 8.0
"""Width at which a picture is printed."""
LEAST_PT = 6.0


def _scene():
    rng = np.random.default_rng(0)
    boxes = np.column_stack([rng.uniform(-60, 60, (9, 2)), np.full((9, 5), [0.8, 4.5, 1.8, 1.6, 0.3])])
    moment = scene_figure.SceneMoment(
        centre_m=np.zeros(2), streets=[np.array([[-200.0, 0], [200, 0]]), np.array([[0.0, -200], [0, 200]])],
        buildings=[(np.array([[20.0, 20], [60, 20], [60, 50], [20, 50]]), 0.0, 15.0)],
        clouds={v: rng.normal(0, 20, (300, 3)) for v in (7, 1234, 99)}, boxes=boxes, equipped=np.arange(9) < 6,
        trust=np.where(np.arange(9) < 4, np.linspace(0, 1, 9), np.nan), attacks=np.arange(9) == 2, ghosts=boxes[:1] + 3,
    )  # fmt: skip
    return scene_figure.draw(moment, "helsinki-1 at 107.0 s, around vehicle 163")


def _sweep():
    xyz = np.random.default_rng(0).normal(0, 20, (500, 3))
    boxes = {name: np.array([[10.0, y, 4.5, 1.8, 0.1]]) for y, name in enumerate(("actors", "detections", "received"))}
    return sweep_figure.draw(xyz, np.arange(500) % 4, boxes, "Vehicle 163 at 107.0 s: 500 returns")


def _city():
    streets = [np.array([[0.0, 0], [900, 300]]), np.array([[0.0, 600], [900, 0]])]
    return city.draw(streets, [3.0, 6.0], [np.array([[100.0, 400], [200, 400], [200, 500]])], "town", "© OpenStreetMap")


def _law():
    age_s, weight = np.arange(1.0, 30), np.exp(-np.arange(29) / 6)
    curves = [law.Curve(name, age_s, weight) for name in ("base", "10 s", "30 s", "beta")]
    at = np.column_stack([np.arange(1, 6), np.arange(2, 12, 2)])
    return law.draw(curves, curves, [law.Points(name, at, 1.1 * at) for name in ("helsinki", "luxembourg")])


def _study(folder, keys):
    """A study of three replicates over these swept keys and their values."""
    rng = np.random.default_rng(0)
    names = ("misbehaviour.auc", "misbehaviour.time_to_detection.median_s")
    measured = [(name, "malicious") for name in names]
    told = study_of(folder, keys, value=lambda *_: rng.uniform(0.2, 0.9), measured=measured)
    return study.draw(told, "misbehaviour", [f"{name}:malicious" for name in names])


def _study_lines(folder):
    return _study(folder, {"trust.freshness_s": [5.0, 20.0, 50.0], "attacks.0.share_p": [0.1, 0.3],
                           "radio.range_m": [100.0, 300.0]})  # fmt: skip


def _study_map(folder):
    models = ["trupercept", "beta", "beta_discounted", "subjective_logic", "mate", "eigentrust", "raya_bayesian"]
    attacks = ["ghost_insertion", "bad_mouthing", "replay", "sybil", "collusion", "on_off", "self_report"]
    return _study(folder, {"attacks.0.attack": attacks, "trust.model": models})


def _compared():
    at = ("50 m, car", "100 m, car", "200 m, pedestrian")
    return compared.draw([
        compared.Panel(f"Fact {i} of some length about radio", "share", at, [0.9, 0.6, 0.2], [0.8, 0.5, 0.1],
                         [0.95, 0.7, 0.3], [0.85, 0.75, 0.1], [0.8, 0.7, 0.05], [0.9, 0.8, 0.2], verdict)
        for i, verdict in enumerate(("agrees", "undecided", "differs", "agrees"))
    ])  # fmt: skip


OTHERS = {
    "scene": _scene, "sweep": _sweep, "city": _city, "law": _law, "compared": _compared,
}  # fmt: skip
OF_STUDIES = {"study": _study_lines, "study heat map": _study_map}


def drawn(name, runs, folder):
    if name in OTHERS:
        return OTHERS[name]()
    return OF_STUDIES[name](folder) if name in OF_STUDIES else FIGURES[name](runs)


@pytest.mark.verify
@pytest.mark.parametrize("name", [*OTHERS, *OF_STUDIES, *FIGURES])
def test_every_text_is_legible(run, other, name, tmp_path):
    for i, runs in enumerate(([run], [run, other])[: 2 if name in FIGURES else 1]):
        with rc_context(style._STYLE):  # ticks are made when they are asked for
            figure = drawn(name, runs, tmp_path)
            said = mistakes(figure)
        assert not said, f"{name} of {i + 1} run(s): {said}"


def test_beside_long_names_titles_end_on_the_page(tmp_path):
    looked = [{"step": 4, "receiver": 2, "subject": v, "trust": 0.5, "n_evaluations": 9} for v in (0, 1)]
    vehicles, runs = attacking(["honest", "malicious", "honest"], {1: 3}), []
    for name in ("raya_dempster_shafer", "beta"):
        (tmp_path / name).mkdir()
        runs.append(tiny.make(tmp_path / name, 20, vehicles=vehicles, trust_lookups=looked))
    with rc_context(style._STYLE):
        assert not mistakes(FIGURES["security"](runs))


ROOT = Path(__file__).parents[2]


def test_pictures_that_ship_are_in_this_style():
    """Their width at their resolution is that of the style, and the program wrote them."""
    tops = ("results", "sensors", "cosim", "trust", "sumo_nets")
    shipped = [path for top in tops for path in (ROOT / top).rglob("*.png")]
    assert len(shipped) > 15
    for path in shipped:
        with Image.open(path) as picture:
            width_cm = 2.54 * picture.width / picture.info.get("dpi", (1, 1))[0]
            assert width_cm == pytest.approx(2.54 * style.WIDTH, rel=0.01), f"{path} is drawn for {width_cm:.1f} cm"
            assert picture.info.get("Software") == style.SOFTWARE, f"{path} is not written by results.figures.style"
    with Image.open(ROOT / "results/pictures/movie.gif") as movie:
        assert movie.width == int(style.WIDTH * DPI), "drawn by cosim plot movie"


def test_no_picture_lies_in_the_root():
    """`cosim nets show CITY` writes into the current folder: a test that calls it names another."""
    assert not [*ROOT.glob("*.png")]


def mistakes(figure):
    """What is wrong with the texts of a picture that is printed at this width."""
    renderer, page = figure.canvas.get_renderer(), figure.bbox
    shrink = WIDTH_CM / 2.54 / figure.get_size_inches()[0]
    found = []
    texts = list(shown_texts(figure))
    boxes = [text.get_window_extent(renderer) for text in texts]
    for text, box in zip(texts, boxes, strict=True):
        if text.get_fontsize() * shrink < LEAST_PT:
            found.append(f"{text.get_text()!r} is {text.get_fontsize() * shrink:.1f} pt")
        if box.x0 < page.x0 - 1 or box.x1 > page.x1 + 1 or box.y0 < page.y0 - 1 or box.y1 > page.y1 + 1:
            found.append(f"{text.get_text()!r} is cut off")
    for (one, a), (two, b) in combinations(zip(texts, boxes, strict=True), 2):
        is_slanted = one.get_rotation() % 90 and one.get_rotation() == two.get_rotation()  # their boxes say too much
        wide, high = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        if wide > 1 and high > 1 and not is_slanted:
            found.append(f"{one.get_text()!r} overlaps {two.get_text()!r}")
    return found


def shown_texts(figure):
    """All texts that are drawn. The labels of ticks outside of the limits are not."""
    ticks, inside = set(), set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for places, labels in ((axis.get_majorticklocs(), axis.get_majorticklabels()),
                                   (axis.get_minorticklocs(), axis.get_minorticklabels())):  # fmt: skip
                ticks |= set(labels)
                room = 1e-6 * (high - low)
                inside |= {
                    label for at, label in zip(places, labels, strict=False)
                    if low - room <= at <= high + room and axes.axison and axis.get_visible()
                }  # fmt: skip
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and (text not in ticks or text in inside):
            yield text


MACHADO = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
"""Colours as seen by those who lack a cone: linear RGB to linear RGB, severity 1.

Machado, Oliveira, Fernandes, "A physiologically-based model for simulation of color vision deficiency", TVCG 2009.
"""


def lab(linear):
    """CIE L*a*b* (D65) of linear sRGB."""
    xyz = linear @ np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
                             [0.0193339, 0.1191920, 0.9503041]]).T / [0.95047, 1.0, 1.08883]  # fmt: skip
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


@pytest.mark.parametrize("seen_as", ["all cones", *MACHADO])
@pytest.mark.parametrize("palette", ["roles", "inks"])
def test_colours_are_told_apart_by_all(seen_as, palette):
    """CIE76 distances of at least 20 between any two roles; 2.3 is the least that is seen side by side [1]_.

    .. [1] M. Mahy, L. Van Eycken, A. Oosterlinck, "Evaluation of uniform color spaces", 1994.
    """
    inks = {**style.ROLE_INKS, "not equipped": style.PALE} if palette == "roles" else dict(enumerate(style.INKS))
    srgb = np.array([to_rgb(ink) for ink in inks.values()])
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    if seen_as in MACHADO:
        linear = np.clip(linear @ np.array(MACHADO[seen_as]).T, 0, 1)
    there = lab(linear)
    apart = {(a, b): float(np.linalg.norm(there[i] - there[j]))
             for (i, a), (j, b) in combinations(enumerate(inks), 2)}  # fmt: skip
    assert min(apart.values()) > 20, min(apart.items(), key=lambda item: item[1])


def test_a_mistake_is_seen():
    """Two texts at one place, one beyond the page, and one of 4 points."""
    figure, (axes,) = style.sheet()
    for x, y, text, size in ((0.5, 0.5, "one", 9), (0.5, 0.5, "two", 9), (1.3, 0.2, "out", 9), (0.1, 0.1, "small", 4)):
        axes.text(x, y, text, fontsize=size)
    figure.canvas.draw()
    said = mistakes(figure)
    assert sorted(said) == ["'one' overlaps 'two'", "'out' is cut off", "'small' is 3.7 pt"], said
