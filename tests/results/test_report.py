"""The report: whole, self-contained, and honest about what is missing."""

import base64
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest

from results import report
from results.archive import open_run
from results.figures import style
from results.figures.catalogue import FIGURES
from results.tables import TABLES
from tests.results.synthetic import write

VOID = {"meta", "img", "br"}


class Outline(HTMLParser):
    """Checks that tags close in order, and gathers what they hold."""

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def text(run, tmp_path_factory):
    """The page of a run."""
    return report.write(run, tmp_path_factory.mktemp("report") / "report.html").read_text()


def test_page(text):
    outline = Outline()
    outline.feed(text)
    assert not outline.open
    pictures = [attributes["src"] for tag, attributes in outline.seen if tag == "img"]
    assert len(pictures) == len(FIGURES) and all(source.startswith("data:image/svg+xml;base64,") for source in pictures)
    links = [attributes["href"] for tag, attributes in outline.seen if tag == "a"]
    anchors = {attributes["id"] for _, attributes in outline.seen if "id" in attributes}
    assert len(text) < 5e6
    assert links and all(link[0] == "#" and link[1:] in anchors for link in links)
    loaded = [a for tag, a in outline.seen if tag in ("script", "link", "iframe") and ("src" in a or "href" in a)]
    assert not loaded and not re.search(r"url\(|@import", re.sub(r"<script.*?</script>", "", text, flags=re.S))
    for name, table in TABLES.items():
        assert f"<summary>{name}" in text
        assert all(f"<code>{column}</code>" in text for column in table.columns)
    assert "range_m" in text and "Resolved configuration" in text


def test_page_of_a_summary_with_a_name_of_markup(tmp_path):
    """Names cannot break the page, what is missing is said, and folders are made."""
    run = open_run(write(tmp_path / "a <b> & c", steps=20, level="summary"))
    text = report.write(run, tmp_path / "new" / "folder" / "report.html").read_text()
    assert "a &lt;b&gt; &amp; c" in text and "<b> & c" not in text
    assert "No figure of freshness" in text and "holds no trust lookups" in text
    assert "not in this run: kept from record level full up" in text


def test_the_numbers_to_read_first_have_their_notes():
    """With few attackers, it was not said that none of them has attacked. An interval about 0.5 proves no chance."""
    few = "has not attacked; too few: 7 of 10 vehicles"
    row = {"value": 0.7, "low": 0.4, "high": 0.9, "n_units": 7, "unit": "1", "label": "", "note": few}
    metrics = ("trust.final.median", "misbehaviour.at_lookup.auc")
    said = report._facts(pd.DataFrame([row | {"metric": metric, "group": "malicious"} for metric in metrics]))
    assert f"final trust, malicious, {few}<" in said and f"against malicious, {few}, may be chance<" in said


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (12345.0, "m", "12,345 m"),
        (0.12345, "1", "0.123"),
        (np.inf, "s", "inf s"),
        (-np.inf, "", "-inf"),
        (np.nan, "s", "-"),
    ],
)
def test_values_of_metrics_as_text(value, unit, text):
    assert report._number(value, unit) == text


def test_a_dense_panel_is_a_bitmap_and_the_rest_stays_vector():
    """A circle of 20,001 points, and 100 points."""
    figure, (dense, sparse) = style.sheet(2)
    angle = np.linspace(0, 2 * np.pi, report.DENSE + 1)
    dense.plot(np.cos(angle), np.sin(angle))
    sparse.plot(angle[:100], angle[:100])
    picture = base64.b64decode(report.image_url(figure).split(",")[1]).decode()
    assert picture.count("<image") == 1
    assert all(line.get_rasterized() for line in dense.lines) and not sparse.lines[0].get_rasterized()


def test_one_screen_and_the_rest_is_folded(text):
    """Few numbers and two figures are open; every other figure, table and the config are in closed sections."""
    start = text.index("<details")
    above = text[:start]
    assert above.count("<img") == len(report.FIRST) and above.count("<table") == 0
    assert 4 <= above.count("<div><b>") <= 8
    assert re.findall(r'<details class="section" id="(\w+)">', text) == ["figures", "numbers", "tables", "provenance"]
    assert 'name="viewport"' in above and "@media (max-width: 600px)" in above
    assert not re.search(r"<details [^>]*open", text.replace("<details open><summary>Resolved", ""))
