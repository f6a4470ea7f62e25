"""Study files and plans: what is asked, what is shared, and what a mistake is answered with. Nothing is driven."""

import json
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.cli import studies as commands
from cosim.config import preset
from cosim.studies import points as study_points
from cosim.studies.folder import Attempt, StudyFolder
from cosim.studies.plan import plan
from cosim.studies.points import identity, points_of, traffic_identity
from cosim.studies.remarks import fleet_notes, name_notes, scene_notes
from cosim.studies.study import SHIPPED, load
from cosim.studies.sweep import prepare
from tests.cosim.traffic import crossing
from tests.refusals import refused_in_one_line
from tests.results.test_study_pages import study_of
from tests.slow import slow

HEAD = """
[study]
name = "try"
replicates = 2
[base]
traffic.duration_s = 10
"""


def write(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return path


def points(tmp_path, text):
    return points_of(load(write(tmp_path, text)), "study.toml")


def test_grid_and_zip_make_every_combination(tmp_path):
    found = points(tmp_path, HEAD + """
[grid]
trust.freshness_s = [5, 10]
"fleet.penetration_p" = [0.2, 0.4, 0.6]
[[zip]]
radio.range_m = [100, 200]
encounters.0.radius_m = [50, 80]
""")  # fmt: skip
    assert len(found) == 2 * 3 * 2 * 2  # windows, penetrations, pairs of values, replicates
    assert {(p.config.radio.range_m, p.config.encounters[0].radius_m) for p in found} == {(100, 50), (200, 80)}
    one, other = found[0].config, found[len(found) // 2].config
    assert (other.seed, other.traffic.seed) == (one.seed + 1, one.traffic.seed + 1)


def test_a_quoted_key_of_the_base_changes_the_default_attacks(tmp_path):
    """As --set does. It took the place of the list of attacks, and the unreliable vehicles were gone."""
    text = HEAD + '"attacks.0.share_p" = 0.25\n[grid]\ntrust.freshness_s = [5]\n'
    first, second = points(tmp_path, text)[0].config.attacks
    assert (first.attack, first.share_p, second.attack) == ("ghost_insertion", 0.25, "unreliable")


def test_a_value_may_stand_twice_in_a_zip_but_no_row(tmp_path):
    text = HEAD + "[[zip]]\nradio.range_m = [100, 100, 200]\ntrust.freshness_s = [5, 10, 5]\n"
    assert len(points(tmp_path, text)) == 2 * 3


def test_identity_is_of_what_is_computed(tmp_path):
    text = HEAD + "[grid]\ntrust.freshness_s = [5, 10]\n"
    plain = [p.id for p in points(tmp_path, text)]
    same = text.replace("[base]", "[base]\ncompute.threads = 2\nrecord.level = 'full'")
    assert [p.id for p in points(tmp_path, same)] == plain
    assert not {p.id for p in points(tmp_path, text.replace("_s = 10", "_s = 11"))} & set(plain)
    assert len(set(plain)) == 4


def test_trust_is_merged_and_traffic_shared(tmp_path):
    found = points(tmp_path, HEAD + """
[grid]
trust.freshness_s = [5, 10, 20]
trust.server_period_s = [1, 2]
trust.host = ["central", "local"]
fleet.penetration_p = [0.2, 0.4]
""")  # fmt: skip
    made = plan(found, fused=False)
    assert len(found) == 48 and len(made.runs) == 4  # penetrations, replicates
    assert sorted(point for run in made.runs for point, _ in run.members) == sorted(p.id for p in found)
    assert len(made.traffic) == 2 and all(run.traffic for run in made.runs)  # replicates
    by_id = {p.id: p for p in found}
    for run in made.runs:
        variants = {v.name: v for v in run.config.trust_variant}
        for point, variant in run.members:
            trust = run.config.trust if variant == "base" else variants[variant].trust
            assert trust == by_id[point].config.trust


def test_merged_points_of_other_models_keep_their_parameters(tmp_path):
    """Both models have this parameter, with other defaults; the study sets it for both."""
    base = f'{HEAD}trust.model = "beta"\ntrust.decay_per_s = 0.9\n[grid]\ntrust.model = ["beta", "belief_graph"]\n'
    asked = points(tmp_path, base)
    found = {point.id: point.config for point in asked}
    for run in plan(asked, fused=False).runs:
        variants = {v.name: v.own for v in run.config.trust_variant}
        for point, variant in run.members:
            own = run.config.own["trust"] if variant == "base" else variants[variant]
            assert own == found[point].own["trust"] and own["decay_per_s"] == 0.9


def test_another_warm_up_of_a_city_is_other_traffic(tmp_path, monkeypatch):
    """A city's recipe states it; no other file of the city changes with it."""

    def names():
        study_points._files.cache_clear()
        found = points(tmp_path, HEAD + "[grid]\nfleet.penetration_p = [0.2]\n")
        return [(point.id, traffic_identity(point.config)) for point in found]

    plain = names()
    assert names() == plain
    real = study_points.scenario_of
    monkeypatch.setattr(study_points, "scenario_of", lambda *where: replace(real(*where), warmup_s=61.0))
    assert not {name for both in plain for name in both} & {name for both in names() for name in both}
    study_points._files.cache_clear()


def test_points_that_change_the_evidence_are_runs_of_their_own(tmp_path):
    for key, values in (("trust.tau", [0.1, 0.2]), ("trust.method", ["trupercept_3", "trupercept_1"])):
        assert len(plan(points(tmp_path, HEAD + f"[grid]\n{key} = {values}"), fused=False).runs) == 4


@pytest.mark.parametrize(
    ("base", "reason"),
    [
        ('server.uplink = "rsu"\nrsu.n_at_junctions = 2', 'server.uplink = "rsu"'),
        ('pseudonyms.revocation = "immediate"', "pseudonyms.revocation"),
        ('pseudonyms.linkage = "own"', "pseudonyms.linkage"),
        ("radio.relay.min_trust = 0.3\nradio.relay.max_hops = 2", "radio.relay.min_trust"),
        ('attacks = [{ attack = "ghost_insertion", when = "sleeper" }]', "attacks: "),
        (
            'attacks = [{ attack = "ghost_insertion", when = "on_off", period_windows = 1.0 }]',
            "attacks.period_windows",
        ),
    ],
)
def test_trust_that_changes_messages_or_attacks_is_not_merged(tmp_path, base, reason):
    """Two windows of evidence and two replicates are four runs."""
    made = plan(points(tmp_path, f"{HEAD}{base}\n[grid]\ntrust.freshness_s = [5, 10]\n"), fused=False)
    assert len(made.runs) == 4
    (remark,) = made.remarks
    assert remark.startswith(reason)


def test_merged_run_is_the_same_for_any_order_of_the_file(tmp_path):
    one = plan(points(tmp_path, HEAD + "[grid]\ntrust.freshness_s = [5, 10]\n"), fused=False)
    other = plan(points(tmp_path, HEAD + '[grid]\n"trust.freshness_s" = [5, 10]\n'), fused=False)
    assert [run.id for run in one.runs] == [run.id for run in other.runs]
    assert all(identity(run.config) == run.id for run in one.runs)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEAD, "sweeps nothing"),
        (HEAD + "[grid]\n", "sweeps nothing"),
        (HEAD + "[grid]\ntrust.freshness_s = []\n", "at least one value"),
        (HEAD + "[grid]\ntrust.freshness_s = 5\n", "list of at least one value"),
        (HEAD + "[grid]\ntrust.freshness_s = [5, 5]\n", "twice"),
        (HEAD + "[[zip]]\nradio.range_m = [1, 1]\ntrust.freshness_s = [5, 5]\n", "twice"),
        (HEAD + "[measure]\nfalse_positives = 5\n[grid]\nradio.range_m = [1, 2]\n", "less than or equal to 1"),
        (HEAD + "[measure]\nown = 'mine'\n[grid]\nradio.range_m = [1, 2]\n", "path.py:name"),
        (HEAD + "[measure]\nown = 'json:lies'\n[grid]\nradio.range_m = [1, 2]\n", "defines no function lies"),
        (HEAD + "[measure]\nown = 'mine.py:lies'\n[grid]\nradio.range_m = [1, 2]\n", "no such file"),
        (HEAD + "[grid]\ntrust.freshnes_s = [5, 6]\n", "unknown key"),
        (HEAD + "[grid]\ntrust.freshness_s = [5, -6]\n", "greater than 0"),
        (HEAD + "[grid]\nseed = [5, 6]\n", "study.replicates"),
        (HEAD.replace("replicates = 2", "replicates = 100_000"), "less than or equal to 1000"),
        (HEAD.replace('name = "try"', 'name = " "'), "name of its file"),
        (HEAD + "[grid]\ncompute.threads = [1, 2]\n", "two points resolve to the same experiment"),
        (HEAD + "[[zip]]\nradio.range_m = [1, 2]\ntrust.freshness_s = [5]\n", "as many"),
        (HEAD + "[grid]\nradio.range_m = [100, 200]\n[[zip]]\nradio.range_m = [1, 2]\n", "swept twice"),
        (HEAD + "[grids]\nradio.range_m = [100, 200]\n", "unknown section"),
        (HEAD + "[keep]\ntables = ['lies']\n[grid]\nradio.range_m = [100, 200]\n", "there is no 'lies'"),
        (HEAD + "[limits]\nretry = 1\n[grid]\nradio.range_m = [100, 200]\n", "Did you mean limits.retries"),
        (HEAD + "[[base.trust_variant]]\nname = 'v'\n[grid]\nradio.range_m = [100, 200]\n", "trust_variant"),
        (
            HEAD.replace("[base]", "baseline = {'trust.tau' = 1}\n[base]") + "[grid]\nradio.range_m = [1, 2]\n",
            "not swept",
        ),
        (
            HEAD.replace("[base]", "baseline = {'radio.range_m' = 1, 'traffic.scale' = 0.5}\n[base]")
            + "[[zip]]\nradio.range_m = [1, 2]\ntraffic.scale = [1.0, 0.5]\n",
            r"no row of \[\[zip\]\] in study.toml has radio.range_m = 1 and traffic.scale = 0.5\. ",
        ),
    ],
)
def test_mistakes_are_one_line(tmp_path, text, said):
    with refused_in_one_line(said):
        points(tmp_path, text)


def test_folder_of_another_study_is_left_alone(tmp_path):
    text = HEAD + "[grid]\nradio.range_m = [100, 200]\n"
    task = prepare(write(tmp_path, text), tmp_path / "out")
    task.folder.prepare(task.study)
    before = (tmp_path / "out" / "study.toml").read_text()
    other = prepare(write(tmp_path, text.replace('"try"', '"other"')), tmp_path / "out")
    with pytest.raises(ValueError, match='holds the study "try"'):
        other.folder.prepare(other.study)
    assert (tmp_path / "out" / "study.toml").read_text() == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("all of it")
    third = prepare(write(tmp_path, text), tmp_path / "mine")
    with pytest.raises(ValueError, match="holds no study"):
        third.folder.prepare(third.study)


def test_the_time_of_a_study_is_that_of_its_typical_run_however_many_points_it_has(tmp_path):
    """One run of three points took 100 s, one of a single point 10 s: 55 s a run, not 100 s."""
    text = HEAD + "[grid]\nradio.range_m = [100, 200]\n"
    folder = StudyFolder(tmp_path / "out")
    for id, n_members, cpu_s in (("a", 3, 100.0), ("b", 1, 10.0)):
        folder.job(id).mkdir(parents=True)
        members = {f"{id} {i}": f"variant {i}" for i in range(n_members)}
        (folder.job(id) / "job.json").write_text(json.dumps({"members": members}))
        folder.add_attempt(id, Attempt("ok", cpu_s, 1, cpu_s=cpu_s))
    task = prepare(write(tmp_path, text), folder.path)
    assert task.estimate.planned_s == pytest.approx(55 * len(task.plan.runs))


def test_study_file_of_a_folder_gives_the_same_points(tmp_path):
    text = (
        HEAD + "[grid]\ntrust.freshness_s = [5, 'off']\n[[zip]]\nradio.range_m = [100, 200]\ntrust.tau = [0.1, 0.2]\n"
    )
    study = load(write(tmp_path, text))
    kept = tmp_path / "kept.toml"
    kept.write_text(study.to_toml())
    assert [p.id for p in points_of(load(kept), "kept")] == [p.id for p in points_of(study, "study.toml")]


def test_meshes_and_attacks_are_files_beside_the_config_that_names_them(tmp_path, monkeypatch):
    configs, elsewhere = tmp_path / "configs", tmp_path / "elsewhere"
    for folder in (configs, elsewhere):
        folder.mkdir()
    (configs / "c.toml").write_text(
        'lidar.engine = "embree"\n[[meshes]]\nfile = "box.ply"\n[[vehicle_meshes]]\nfile = "car.ply"\n'
        '[[attacks]]\nattack = "mine.py:Mine"\n'
    )
    (configs / "mine.py").write_text("class Mine:\n    def identities(self, context):\n        return ()\n")
    (tmp_path / "other.ply").touch()
    swept = '[study]\nconfig = "configs/c.toml"\n[grid]\n'
    kept = load(write(tmp_path, swept + "radio.range_m = [100]\n"))
    chosen = load(write(tmp_path, swept + 'meshes.0.file = ["other.ply"]\n'))
    monkeypatch.chdir(elsewhere)
    for study, mesh in ((kept, configs / "box.ply"), (chosen, tmp_path / "other.ply")):
        (point,) = points_of(study, "study.toml")
        assert point.config.meshes[0].file == str(mesh)
        assert point.config.vehicle_meshes[0].file == str(configs / "car.ply")
        assert point.config.attacks[0].attack == f"{configs / 'mine.py'}:Mine"


@pytest.mark.parametrize(
    ("name", "n_points", "n_runs"),
    [
        ("freshness", 300, 15),
        ("exposure", 27, 27),
        ("encounters", 9, 9),
        ("safety", 48, 48),
        slow("attacks", 780, 39),
        ("safety_half_hour", 24, 24),
        ("whitewashing", 20, 20),
        ("revocation", 16, 16),
        ("busy_channel", 8, 8),
        ("redundancy", 40, 40),
        ("asynchrony", 135, 54),
        ("weather", 48, 48),
        ("access", 48, 48),
        ("presets", 6, 6),
        ("deviations", 35, 35),
        slow("cities", 8, 8),  # builds two cities
        ("strangers", 32, 8),
        ("paper_tables", 200, 80),
    ],
)
def test_shipped_studies(name, n_points, n_runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(preset, "DEFAULT", "modern")
    Path(name).mkdir()  # such as the folder of an earlier sweep: the name still is that of the study
    found = points_of(load(Path(name)), name)
    assert len(found) == n_points and len(plan(found, fused=False).runs) == n_runs


def test_cities_without_buildings_are_noted(tmp_path):
    city = crossing.write(tmp_path)
    text = f'[study]\nname = "s"\n[base]\ntraffic.warmup_s = 60\n[grid]\ntraffic.scenario = ["helsinki", "{city}"]\n'
    (tmp_path / "s.toml").write_text(text)
    (note,) = scene_notes(points_of(load(tmp_path / "s.toml"), "s"))
    assert note.startswith(f"note: {city} has no buildings to block lines of sight")


@pytest.mark.parametrize("scales", ["1.0, 0.02", "0.02, 1.0"])
def test_points_with_hardly_any_traffic_are_noted(tmp_path, scales):
    """Of 200 vehicles 0.02 are 4, of which 0.35 are equipped; the replicates are one case."""
    (note,) = fleet_notes(points(tmp_path, HEAD + f"[grid]\ntraffic.scale = [{scales}]\n"))
    assert note.startswith("note: about 1.4 equipped vehicles")
    assert "traffic.scale = 0.02 and fleet.penetration_p = 0.35. So few" in note


def test_a_changed_copy_of_a_shipped_study_should_have_its_own_name(tmp_path):
    text = (SHIPPED / "question.toml").read_text()
    for path, content, n in (("same.toml", text, 0), ("mine.toml", text.replace("0.3, 0.6]", "0.3]"), 1)):
        (tmp_path / path).write_text(content)
        assert len(name_notes(tmp_path / path, load(tmp_path / path))) == n
    assert not name_notes(Path("question"), load(Path("question")))


def test_a_baseline_has_the_values_of_the_study_and_all_keys_of_its_row(tmp_path):
    """10 as in the grid, not 10.0: beside words, numbers are stored as text. A key of a row stands for the row."""
    swept = """
[grid]
trust.freshness_s = ["off", 10]
[[zip]]
radio.range_m = [100, 200, 200]
traffic.scale = [0.5, 1.0, 1.5]
"""
    for stated, wanted in (
        ("{ 'trust.freshness_s' = 10.0 }", {"trust.freshness_s": 10}),
        ("{ 'radio.range_m' = 100 }", {"radio.range_m": 100, "traffic.scale": 0.5}),
        ("{ 'radio.range_m' = 200 }", {"radio.range_m": 200}),
    ):
        text = HEAD.replace("[base]", f"baseline = {stated}\n[base]") + swept
        baseline = load(write(tmp_path, text)).head.baseline
        assert baseline == wanted and [*map(type, baseline.values())] == [*map(type, wanted.values())]


def test_lists_are_swept_and_a_key_is_held_at_one_value(tmp_path, capsys):
    """After a sweep, other keys are held at the baseline, whatever it is."""
    kinds = ('["car"]', '["car", "van"]')
    swept = {"fleet.penetration_p": (0.1, 0.3), "fleet.equipped_kinds": kinds}
    made = study_of(tmp_path, swept, baseline={"fleet.equipped_kinds": ["car", "van"]})
    head = {"name": made.name, "question": "", "keys": list(swept), "baseline": made.baseline}
    table = pa.Table.from_pandas(made.points).replace_schema_metadata({"study": json.dumps(head)})
    pq.write_table(table, tmp_path / "index.parquet")
    commands._print_first(tmp_path)
    assert '["car", "van"]' in capsys.readouterr().out
    commands.measure(tmp_path, [], True, where=["fleet.penetration_p=0.1"])
    with pytest.raises(ValueError, match="a key is held at one value"):
        commands.measure(tmp_path, [], True, where=["fleet.penetration_p=0.1", "fleet.penetration_p=0.3"])
