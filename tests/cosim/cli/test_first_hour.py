"""What a newcomer types first: explain, init, cite, check, and files given to the wrong command."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from cosim.cli.explain import look_up
from cosim.config.config import load
from cosim.config.key_docs import keys
from cosim.door.kinds import KINDS
from results import cite
from results.glossary import GLOSSARY
from results.metrics.registry import METRICS
from results.tables import TABLES
from tests.drive import cosim, drive


@pytest.mark.parametrize(
    ("word", "name", "kind", "says"),
    [
        ("penetration_p", "fleet.penetration_p", "key of the config", "0.35"),
        ("attacks.1.share_p", "attacks.share_p", "key of the config", "Share of the equipped vehicles"),
        ("--set radio.range_m=3", "radio.range_m", "key of the config", "300"),
        ("n_ghosts", "attacks.n_ghosts", 'key of the config, [[attacks]] attack = "sybil"', "ghost"),
        ("AUC", "ROC, AUC", "term", "receiver operating characteristic"),
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
        ("freshness", "freshness", "study that ships", "How old"),
    ],
)
def test_a_word_is_explained(word, name, kind, says):
    found = [e for e in look_up(word, _commands) if (e.name, e.kind) == (name, kind)]
    assert len(found) == 1
    assert says in found[0].meaning


def refused_in_one_line(done, says):
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert says in done.stderr


def _commands():
    import typer

    from cosim.cli.explain import _commands as commands
    from cosim.cli.main import app

    return commands(typer.main.get_command(app))


def test_everything_that_has_a_name_is_found():
    names = [*keys(), *METRICS, *TABLES, *GLOSSARY, *(f"{t}.{c}" for t, table in TABLES.items() for c in table.columns)]
    names += [name for kind in KINDS.values() for name in kind.shipped]
    from cosim.cli import explain

    entries = list(explain._entries())
    known = {entry.name for entry in entries}
    assert set(names) <= known
    assert [entry.name for entry in entries if len(entry.meaning) < 4] == []


@pytest.mark.parametrize(
    ("word", "near"), [("penetraton_p", "fleet.penetration_p"), ("sybill", "sybil"), ("trsut", "trust")]
)
def test_close_words_are_named_where_none_fits(word, near):
    done = cosim("explain", word)
    refused_in_one_line(done, near)


def test_explain_prints_json():
    (found,) = json.loads(cosim("explain", "fleet.penetration_p", "--json").stdout)
    assert found["name"] == "fleet.penetration_p" and found["kind"] == "key of the config"


def test_init_writes_a_config_that_runs_and_a_study(tmp_path):
    done = cosim("init", cwd=tmp_path)
    text = (tmp_path / "mine.toml").read_text()
    assert done.returncode == 0 and "cosim run mine.toml" in done.stdout
    assert len(text.splitlines()) == 15 and load(tmp_path / "mine.toml").fleet.penetration_p == 0.35
    assert cosim("check", "mine.toml", cwd=tmp_path).returncode == 0
    again = cosim("init", cwd=tmp_path)
    assert again.returncode == 2 and "is there already" in again.stderr and (tmp_path / "mine.toml").read_text() == text
    assert cosim("init", "--study", "ages.toml", cwd=tmp_path).returncode == 0
    checked = cosim("check", "ages.toml", cwd=tmp_path)
    assert checked.returncode == 0 and "12 points" in checked.stdout and "cosim sweep ages.toml" in checked.stdout
    assert cosim("init", "mine.yaml", cwd=tmp_path).returncode == 2


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", "ages.toml"], "cosim sweep ages.toml --out runs/ages"),
        (["run", "freshness"], "cosim sweep freshness --out runs/freshness"),
        (["sweep", "mine.toml", "--out", "x"], "cosim run mine.toml"),
        (["run", "my.osm.pbf"], "cosim nets build --osm my.osm.pbf --out my"),
        (["check", "--set", "traffic.scenario=my.osm.pbf"], "my.osm.pbf --out my, cosim run"),
        (["sweep", "my.osm.pbf", "--out", "x"], "cosim nets build --osm my.osm.pbf --out my"),
        (["sweep", "ages.toml", "--out", "x", "--set", "fleet.penetration_p=1", "--dry-run"], "the study sweeps"),
        (["sweep", "ages.toml", "--out", "x", "--set", "fleet.penetration=1", "--dry-run"], "unknown key"),
        (["check", "ages.toml", "--preset", "moder"], "there is no such preset"),
    ],
)
def test_the_wrong_command_names_the_right_one(tmp_path, words, says):
    cosim("init", cwd=tmp_path)
    cosim("init", "--study", "ages.toml", cwd=tmp_path)
    (tmp_path / "my.osm.pbf").write_bytes(b"")
    done = cosim(*words, cwd=tmp_path)
    refused_in_one_line(done, says)


def test_a_study_takes_changes_of_its_base(tmp_path):
    cosim("init", "--study", "ages.toml", cwd=tmp_path)
    words = ["sweep", "ages.toml", "--out", "x", "--dry-run", "--json"]
    long, short = (
        json.loads(cosim(*words, *more, cwd=tmp_path).stdout) for more in ([], ["--set", "traffic.duration_s=12"])
    )
    assert long["points"] == short["points"] == 12
    assert long["MB"] > 4 * short["MB"]
    assert cosim("check", "ages.toml", "--preset", "v0.2", "--all", cwd=tmp_path).stdout.count('preset = "v0.2"') == 1


def test_check_says_what_changes_and_what_follows(tmp_path):
    (tmp_path / "mine.toml").write_text(
        'preset = "v0.2"\n[traffic]\nduration_s = 3600\n[fleet]\npenetration_p = 1.0\n'
        '[[attacks]]\nattack = "sybil"\nshare_p = 0.3\nn_ghosts = 7\n[trust]\nmodel = "beta"\n'
    )
    said = cosim("check", "mine.toml", cwd=tmp_path).stdout
    for line in (
        "5 keys differ from the default of preset v0.2",
        "traffic.duration_s = 3600 (default 180)",
        'attacks.0 = { attack = "sybil", share_p = 0.3, n_ghosts = 7 }',
        'trust.model = "beta" (default "trupercept")',
        "about 200 on the road, 200 of them with LiDAR and radio",
        "about 200 sweeps of 33,280 rays, and up to 400 messages",
        "cosim run mine.toml",
    ):
        assert line in said, line
    assert re.search(r"time +about \d", said) and re.search(r"memory +about 0\.\d GB; \d+ MB on disk", said)
    assert len(said.splitlines()) <= 24
    whole = cosim("check", "mine.toml", "--all", cwd=tmp_path).stdout
    assert tomllib.loads(whole)["attacks"][0]["n_ghosts"] == 7


def test_check_loads_what_it_needs():
    """Neither tables nor figures nor SUMO: loading them took longer than the check."""
    code = """
import sys
from cosim.cli.main import main
sys.argv = ["cosim", "check"]
try:
    main()
except SystemExit:
    print(*sorted({"pandas", "matplotlib", "libsumo", "networkx", "distributed"} & set(sys.modules)), "loaded")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded"


def test_check_of_a_study_says_what_it_takes(tmp_path):
    cosim("init", "--study", "ages.toml", cwd=tmp_path)
    said = cosim("check", "ages.toml", cwd=tmp_path).stdout
    assert re.search(r"about \d+ (s|min) with \d+ workers? on free cores, and \d\.\d GB of memory", said)
    assert "fleet.penetration_p: 0.1, 0.35" in said
    long = cosim("check", "ages.toml", "--set", "traffic.duration_s=36000", cwd=tmp_path).stdout
    assert "half of it: --set traffic.duration_s=18000" in long


def test_check_of_the_default_changes_nothing():
    assert "no key differs" in cosim("check").stdout


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return drive(
        tmp_path_factory.mktemp("cite") / "run", "trust.model=beta", "driver.model=cautious", "traffic.step_s=0.5"
    )


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
    root = Path(cite.__file__).parents[1]
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
