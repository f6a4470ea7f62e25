"""What a word means, and what to cite."""

import json
import re
from pathlib import Path

import pytest

from cosim.addons.explain import cite, config_page, dictionary, lookup
from cosim.addons.explain.glossary import GLOSSARY
from cosim.addons.explain.key_docs import keys
from cosim.addons.explain.lookup import look_up
from cosim.config import preset
from cosim.config.config import with_defaults
from cosim.config.data import assign
from cosim.door.kinds import KINDS
from cosim.traffic.scenario import find
from results import tables
from results.metrics.registry import METRICS
from results.tables import TABLES
from tests.drive import assert_refused, cosim, drive


@pytest.mark.parametrize(
    ("word", "name", "kind", "says"),
    [
        ("penetration_p", "fleet.penetration_p", "key of the config", "0.35"),
        ("attacks.1.share_p", "attacks.share_p", "key of the config", "Share of the equipped vehicles"),
        ("--set radio.range_m=3", "radio.range_m", "key of the config", "300"),
        ("n_ghosts", "attacks.n_ghosts", 'key of the config, [[attacks]] attack = "sybil"', "ghost"),
        ("AUC", "ROC, AUC", "term", "receiver operating characteristic"),
        ("channel busy ratio", "CBR, channel busy ratio", "term", "Share of the time"),
        ("radio.dcc", "radio.dcc", "section of the config", "t_off_s"),
        ("equipped vehicle", "equipped vehicle", "term", "LiDAR"),
        ("misbehaviour.auc", "misbehaviour.auc", "metric", ""),
        ("trust_lookups", "trust_lookups", "table of a run", "before fusion"),
        ("trust_lookups.age_s", "trust_lookups.age_s", "column [s]", ""),
        ("sybil", "sybil", "attack", "ghost vehicles"),
        ("Beta", "beta", "trust model", "Jøsang and Ismail (2002)"),
        ("csma", "csma", "radio medium", "IEEE 802.11-2016"),
        ("cosim run", "run", "command", "--watch-file"),
        ("nets build", "nets build", "command", "--overpass"),
        ("modern", "modern", "preset", ""),
        ("helsinki", "helsinki", "city", "Helsinki"),
        ("durations", "durations", "figure", "Kaplan-Meier"),
        ("freshness", "freshness", "study that ships", "How old"),
    ],
)
def test_a_word_is_explained(word, name, kind, says):
    found = [e for e in look_up(word, _commands) if (e.name, e.kind) == (name, kind)]
    assert len(found) == 1
    assert says in found[0].meaning


def _commands():
    import typer

    from cosim.cli.main import app

    return lookup.commands(typer.main.get_command(app))


def test_everything_that_has_a_name_is_found():
    names = [*keys(), *METRICS, *TABLES, *GLOSSARY, *(f"{t}.{c}" for t, table in TABLES.items() for c in table.columns)]
    names += [name for kind in KINDS.values() for name in kind.shipped]
    entries = list(lookup._entries())
    known = {entry.name for entry in entries}
    assert set(names) <= known
    assert [entry.name for entry in entries if len(entry.meaning) < 4] == []


def test_a_key_is_set_as_its_explanation_says():
    """Also a key of a list of sections, such as `attacks.0.share_p`."""
    set_by = [e.where.split("--set ")[1].removesuffix("=...") for e in lookup._keys() if "--set " in e.where]
    assert {"attacks.0.share_p", "radio.range_m", "trust_variant.0.name"} <= set(set_by)
    for name in set_by:
        assign(with_defaults({}), name, 1, name)


def test_a_metric_is_defined_without_the_one_before():
    leans = re.compile(r".*?\b([Tt]he same|these|those|that threshold|such a|the other) (?!subjects)")
    first = {name: re.split(r"(?<=[.:;]) ", metric.definition)[0] for name, metric in METRICS.items()}
    assert [name for name, sentence in first.items() if leans.match(sentence)] == []


@pytest.mark.parametrize(
    ("word", "near"),
    [("penetraton_p", "fleet.penetration_p"), ("sybill", "sybil"), ("trsut", "trust"), (" ", "error: no word is ")],
)
def test_close_words_are_named_where_none_fits(word, near):
    done = cosim("explain", word)
    assert_refused(done, near)


def test_explain_prints_json():
    (found,) = json.loads(cosim("explain", "fleet.penetration_p", "--json").stdout)
    assert found["name"] == "fleet.penetration_p" and found["kind"] == "key of the config"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return drive(
        tmp_path_factory.mktemp("cite") / "run", "trust.model=beta", "driver.model=cautious", "traffic.step_s=0.5",
        "traffic.duration_s=2", "traffic.warmup_s=10",
    )  # fmt: skip


def test_a_run_is_cited_by_what_it_used(run):
    said = cosim("cite", str(run)).stdout
    for words in (
        "Eclipse SUMO",
        "Microscopic Traffic Simulation",
        "ODbL-1.0",
        "The Beta Reputation System",
        "802.11",
        "Krauss",
    ):
        assert words in said, words
    assert "EigenTrust" not in said and "38.214" not in said
    entries = re.findall(r"^@(\w+)\{(\w+),$", cosim("cite", str(run), "--bibtex").stdout, flags=re.MULTILINE)
    keys = [key for _, key in entries]
    assert len(set(keys)) == len(keys) and {"josang2002", "lopez2018", "krauss1998", "hurl2020"} <= set(keys)
    (first, *_) = json.loads(cosim("cite", str(run), "--json").stdout)
    assert first["part"] == "cosim"


def test_traffic_is_cited_as_what_it_was(run, tmp_path):
    """SUMO's in a city; a trace without a city; a run in its city, whose demand is that of the city."""
    trace = tmp_path / "ring.xml"
    trace.write_text("<fcd-export/>")
    for scenario, expected in (
        ("helsinki", ["traffic, Eclipse SUMO 1.28.0", "city helsinki"]),
        (trace, ["replayed traffic, ring.xml"]),
        (run, ["replayed traffic, run", "city helsinki"]),
    ):
        manifest = {
            "config": {"sensing": False, "traffic": {"scenario": str(scenario), "trace": None}},
            "versions": {"libsumo": "1.28.0"},
            "net": find(str(scenario)).provenance() | {"sha256 meshes.0.file": "0"},
        }
        assert [part.what for part in cite.parts(manifest)] == ["cosim", *expected]


def test_references_are_those_of_docstrings():
    """Every trust model's references are those that its file names by number; every key exists."""
    import inspect

    numbers = {one["trust"]: key for key, one in cite.references().items() if "trust" in one}
    for name, made in KINDS["trust"].shipped.items():
        source = inspect.getsource(inspect.getmodule(made))
        named = {numbers[int(n)] for n in re.findall(r"\[(\d+)\]_", source)}
        assert named <= set(cite.USED_BY["trust"][name]), name
    assert set(cite.USED_BY["trust"]) == set(KINDS["trust"].shipped)
    for known in cite.USED_BY.values():
        assert {key for found in known.values() for key in found} <= cite.references().keys()
    source = Path(cite.__file__).read_text() + Path(cite.__file__).with_name("references.toml").read_text()
    unused = [key for key in cite.references() if f'"{key}"' not in source]
    assert unused == []


def test_references_are_named_in_the_project():
    """By their titles, in a docstring, page, profile or README; SUMO's is what its authors ask for."""
    root = Path(cite.__file__).parents[3]
    files = [
        p
        for room in ("cosim", "sensors", "trust", "results")
        for p in (root / room).rglob("*")
        if p.suffix in (".py", ".md", ".toml")
    ]
    texts = [" ".join(p.read_text().split()).lower() for p in files if p.name != "references.toml"]
    for key, one in cite.references().items():
        title = re.split(r"[,:]", one["title"])[0].lower()
        assert key == "lopez2018" or any(title in text for text in texts), key


def test_tables_md_is_the_code():
    text = (Path(tables.__file__).parent / "TABLES.md").read_text()
    assert text == dictionary.markdown(), "run python -m cosim.addons.explain.dictionary"


def test_the_page_of_keys_has_the_defaults_of_a_file(monkeypatch):
    monkeypatch.setattr(preset, "DEFAULT", "modern")
    text = config_page.markdown()
    assert "| `lidar.max_range_m` | number; > 0, ≤ 1000 | `100` |" in text
    assert '| `"modern"` |' in text and "| `extrapolate` | true or false | `true` |" in text
