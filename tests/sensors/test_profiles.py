"""The published detectors: complete, with sources, and fitted as the README states."""

import tomllib
from dataclasses import fields
from pathlib import Path

import pytest

import sensors
from sensors.detector import DETECTORS
from sensors.statistical_detector import DetectorParams

ROOM = Path(sensors.__file__).parent
FILES = {path.stem: tomllib.loads(path.read_text()) for path in sorted((ROOM / "profiles").glob("*.toml"))}
FAR_OFF = {("avod", "pedestrian", "all"), ("pointpillars", "cyclist", "moderate")}
"""Figures more than 5 points off the published ones; the README gives the reasons."""


def test_every_profile_has_a_file():
    assert {*FILES, "ideal"} == set(DETECTORS)


@pytest.mark.parametrize("name", FILES)
def test_complete_and_sourced(name):
    file = FILES[name]
    stated = {"source", *(f.name for f in fields(DetectorParams) if f.name != "model")}
    assert set(file["first_guess"]) == stated and set(file["fitted"]) < stated
    assert len(file["source"]) > 20 and len(file["first_guess"]["source"]) > 20
    assert {*file["published"], "elsewhere"} == set(file["published_source"])


@pytest.mark.parametrize("name", FILES)
def test_close_to_what_was_published(name):
    report = FILES[name]["calibration"]
    for label, published in FILES[name]["published"].items():
        assert report[label]["published"] == published
        for level, target, reached in zip(report["levels"], published, report[label]["reached"], strict=False):
            assert abs(reached - target) <= 5 or (name, label, level) in FAR_OFF, (name, label, level)
        hits, others = report[label]["boxes_per_frame_above_half"]
        assert others < 0.5 * hits  # boxes of high score are mostly true


def rows(name: str) -> list[str]:
    """The calibration as lines of the README's table."""
    report, lines = FILES[name]["calibration"], []
    names = {"published": "published", "reached": "reached", "most_that_can_be": "at most",
             "reached_of_the_seen": "reached, of those that return anything"}  # fmt: skip
    for label, published in FILES[name]["published"].items():
        for key, what in names.items():
            figures = report[label][key] if key != "published" else published
            cells = [f"{v:.1f}" for v in figures] + ["-"] * (4 - len(figures))
            lines.append(f"| {name} | {label} | {what} | {' | '.join(cells)} |")
    return lines


@pytest.mark.parametrize("name", FILES)
def test_the_readme_has_the_calibration(name):
    text = (ROOM / "README.md").read_text()
    missing = [line for line in rows(name) if line not in text]
    assert not missing, "write into sensors/README.md:\n" + "\n".join(missing)
