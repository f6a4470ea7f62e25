"""One typed experiment: what it takes, and how it says no."""

import tomllib
from dataclasses import replace

import pytest

from cosim.config.config import Config, chosen, chosen_model, load
from cosim.runs.manifest import toml_text
from tests.refusals import refused_in_one_line


def test_defaults_survive_the_way_to_disk_and_back(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text(toml_text(load().to_dict()))
    assert load(path) == load()
    plain = replace(load(), attacks=(), own={}, trust_variant=())  # a file states its own attacks and variants
    assert plain == Config()


def test_file_then_overrides(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("seed = 4\n[radio]\nrange_m = 150\n[[encounters]]\nradius_m = 50\n[[encounters]]\nradius_m = 250\n")
    config = load(path, ["radio.range_m=200.5", "trust.method=local", "seed=9"])
    assert (config.seed, config.radio.range_m, config.trust.method) == (9, 200.5, "local")
    assert [e.radius_m for e in config.encounters] == [50, 250]


def test_the_first_item_of_a_list_of_sections_can_be_set():
    sets = ["roadside.0.junctions=3", "sensing_groups.0.share_p=0.5", "sensing_groups.0.interval_s=2"]
    config = load(None, [*sets, "trust_variant.0.name=other", "trust_variant.0.freshness_s=5"])
    assert config.roadside[0].junctions == 3 and config.sensing_groups[0].interval_s == 2
    assert config.trust_variant[0].trust.freshness_s == 5


@pytest.mark.parametrize("step_s", [0.3, 1, 2])
def test_without_sensing_its_keys_refuse_no_run(step_s):
    """The default preset senses at random times within a second; a trace of 1 s is wanted for its encounters alone."""
    sets = [f"traffic.step_s={step_s}", "traffic.duration_s=12", "sensing_phase=random"]
    with pytest.raises(ValueError, match="sensing"):
        load(None, sets)
    config = load(None, [*sets, "sensing=false", "radio.timeout_s=0.9"])
    assert config.schedule.is_lock_step and config.n_steps == round(12 / step_s)


def test_a_scenario_is_found_beside_the_file_that_names_it(tmp_path):
    (tmp_path / "city.sumocfg").touch()
    path = tmp_path / "mine.toml"
    path.write_text('[traffic]\nscenario = "city.sumocfg"\n')
    assert load(path).traffic.scenario == str(tmp_path / "city.sumocfg")
    (tmp_path / "town").mkdir()
    (tmp_path / "town" / "city.cfg").write_text("<configuration/>")
    path.write_text('[traffic]\nscenario = "town"\n')
    assert load(path).traffic.scenario == str(tmp_path / "town")


@pytest.mark.parametrize(
    ("said", "set_", "step_s"),
    [('<time><step-length value="0.1"/></time>', [], 0.1), ("<step-length>0.5</step-length>", [], 0.5), ("", [], 1.0),
     ('<step-length value="0.1"/>', ["traffic.step_s=0.25"], 0.25), ('<step-length value="soon"/>', [], 1.0),
     ('<step-length value="0:00:00.5"/>', [], 0.5),
     ('<step-length value="0.1"/>', ["traffic.trace='fcd.parquet'"], 1.0)],
)  # fmt: skip
@pytest.mark.parametrize("name", ["city.sumocfg", "city.sumo.cfg", "city.cfg"])
def test_a_scenario_keeps_its_own_step(tmp_path, name, said, set_, step_s):
    """Longer steps drive otherwise: who calibrated a scenario at 0.1 s wants it driven so."""
    config = tmp_path / name
    config.write_text(f"<configuration>{said}</configuration>")
    assert load(None, [f"traffic.scenario={config}", *set_]).traffic.step_s == step_s
    assert load(None, [f"traffic.scenario={tmp_path}", *set_]).traffic.step_s == step_s


def test_a_step_too_short_is_named_where_it_stands(tmp_path):
    config = tmp_path / "city.sumocfg"
    config.write_text('<configuration><step-length value="0.01"/></configuration>')
    with pytest.raises(ValueError, match=r"city.sumocfg: its step-length of 0.01 s .* Set traffic.step_s"):
        load(None, [f"traffic.scenario={config}"])
    assert load(None, [f"traffic.scenario={config}", "traffic.step_s=0.1"]).traffic.step_s == 0.1


def test_a_scenario_that_lies_about_is_nobodys(tmp_path, monkeypatch):
    """Whoever names no scenario gets the shipped one, with its step."""
    (tmp_path / "city.sumocfg").write_text('<configuration><step-length value="0.1"/></configuration>')
    monkeypatch.chdir(tmp_path)
    assert load(None, ["traffic.duration_s=9"]).traffic.step_s == 1.0
    assert load(None, ["traffic.scenario=helsinki"]).traffic.step_s == 1.0


def test_steps():
    config = load(None, ["traffic.step_s=0.1", "sensing_interval_s=0.5", "traffic.duration_s=60"])
    assert (config.sense_every_steps, config.n_steps) == (5, 600)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("radio.raneg_m=3", "unknown key .* Did you mean radio.range_m"),
        ("nonsense=3", "unknown key .* Known: preset, seed"),
        ("radio.range_m=-3", r"radio.range_m = -3 should be greater than 0. Set radio.range_m in"),
        ("radio.range_m=0.3", "Metres, not kilometres"),
        ("radio.range_m='far'", "valid number"),
        ("radio.range_m=true", "valid number"),
        ("radio.range_m=inf", "not a finite number"),
        ("radio.range_m=nan", "not a finite number"),
        ("radio.relay.max_hops=1.5", "valid integer"),
        ("radio.timeout_s=0.6", "two messages of a sweep do not fit"),
        ("radio.access.lifetime_s=0.0001", "shorter than the transmission"),
        ("radio.timeout_s=0.001", "no time for more than a few frames"),
        ("radio=3", r"section \[radio\]"),
        ("trust.freshness_s='never'", r"^trust\.freshness_s = 'never' should be a valid number or 'off'\. Set trust\."),
        ("lidar.rotation_hz=-3", r"^lidar\.rotation_hz = -3 should be greater than 0 or 'off'\. Set lidar\."),
        ("lidar.rotation_hz=0.5", "a sweep takes 2 s, and the next one begins after 1 s. Set it to 1 or more"),
        ("seed.x=1", "unknown key|section|valid"),
        ("fleet.equipped_kinds=['tank']", "fleet.equipped_kinds"),
        ("attacks.0.share_p=0.95", "more than all equipped"),
        ("attacks.2.share_p=0.1", r"attacks has 2 sections, numbered from 0\. .* what it is: attacks\.2\.attack\.$"),
        ("fleet.malicious_p=0.95", "fleet.malicious_p: unknown key"),
        ("sensing_interval_s=0.7", "not a multiple of traffic.step_s"),
        ("encounters=[{radius=3}]", "unknown key .* Did you mean encounters.0.radius_m"),
        ("encounters=3", "list of sections"),
        ("record.level='all'", "record.level"),
        ("no_equals", "not of the form key=value"),
        ("radio.cpm_rules='etsi'", "unknown key"),
        ("trust.unjudged='value'", "unknown key"),
        ("cpm.redundancy=entropy", "cpm.redundancy"),
        ("cpm.max_objects=0", "cpm.max_objects"),
        ("cpm.interval_s=0.05", "cpm.interval_s"),
        ("cpm.length=ber", "cpm.length"),
        ("cpm=3", "cpm"),
    ],
)
def test_bad_values_get_one_line(override, words):
    with refused_in_one_line(words):
        load(None, [override])


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"seed = ", "not valid TOML"), (b"\xff\xfe", "cannot be read"), (b"[[radio]]\nrange_m = 1", "section")],
)
def test_bad_files(tmp_path, content, words):
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=words):
        load(path)


def test_a_mark_of_utf_8_at_the_beginning_is_left_out(tmp_path):
    path = tmp_path / "from-windows.toml"
    path.write_bytes(b"\xef\xbb\xbfseed = 7\r\n[traffic]\r\nduration_s = 5\r\n")
    config = load(path)
    assert (config.seed, config.traffic.duration_s) == (7, 5)


def test_missing_file(tmp_path):
    with pytest.raises(ValueError, match="no such config file"):
        load(tmp_path / "none.toml")


def test_every_knob_says_its_meaning():
    """Each field of each section is followed by a docstring line, in the source."""
    import ast
    import inspect
    from dataclasses import fields, is_dataclass
    from typing import get_args

    sections = [f.type if is_dataclass(f.type) else (get_args(f.type) or (f.type,))[0] for f in fields(Config)]
    for section in [Config, *(s for s in sections if is_dataclass(s))]:
        body = ast.parse(inspect.getsource(section)).body[0].body
        for node, after in zip(body, [*body[1:], None], strict=True):
            if isinstance(node, ast.AnnAssign) and not is_dataclass(section.__annotations__[node.target.id]):
                documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                assert documented or section is Config, f"{section.__name__}.{node.target.id} has no meaning"


def test_toml_round_trip_is_plain_toml():
    assert tomllib.loads(toml_text(Config().to_dict()))["radio"]["range_m"] == 300.0


@pytest.mark.parametrize(
    ("first", "second"), [("radius_m=100", "radius_m=100.0000001"), ("hysteresis_s=3", "hysteresis_s=3.00000001")]
)
def test_encounters_that_are_equal_in_32_bits_are_refused(first, second):
    """Tables keep radii as 32-bit numbers: two such definitions would write the same rows."""
    with pytest.raises(ValueError, match=r"encounters\.1 is the same definition as encounters\.0"):
        load(None, [f"encounters.0.{first}", f"encounters.1.{second}"])
    assert len(load(None, ["encounters.0.radius_m=100", "encounters.1.radius_m=100.00001"]).encounters) == 2


def test_an_own_default_counts_where_a_key_of_the_same_name_is_not_set(tmp_path):
    """`detector.half_returns` has no value unless it is given; `pseudonyms.own_gap_s` has one."""
    head = "from dataclasses import dataclass\n\n@dataclass(frozen=True)\nclass Params:\n    {}\n\n"
    body = "class Mine:\n    Params = Params\n\n    def __init__(self, params):\n        pass\n\n    def {}: pass\n"
    detect = "detect(self, sweeps, seen, boxes, label, draws)"
    (tmp_path / "mine.py").write_text(head.format("half_returns: float = 15.0") + body.format(detect))
    (tmp_path / "mine.toml").write_text('[detector]\nmodel = "mine.py:Mine"\n')
    assert chosen(load(tmp_path / "mine.toml"), "detector")[1].half_returns == 15.0
    changes = "changes(self, ages)"
    (tmp_path / "policy.py").write_text(head.format("own_gap_s: float = 7.0") + body.format(changes))
    (tmp_path / "mine.toml").write_text('[pseudonyms]\npolicy = "policy.py:Mine"\n')
    assert chosen(load(tmp_path / "mine.toml"), "pseudonyms")[1].own_gap_s == 1.5


@pytest.mark.parametrize(
    ("of_trust", "of_variant", "decay_per_s"), [("beta", "belief_graph", 0.95), ("eigentrust", "beta", 0.98)]
)
def test_a_variant_of_another_model_has_that_model_s_defaults(of_trust, of_variant, decay_per_s):
    """Both have a parameter of this name, and each its own value where nobody sets one."""
    variant = "trust_variant.0.name=other", f"trust_variant.0.model={of_variant}"
    for sets in ((), ("trust.decay_per_s=0.5",)):
        config = load(None, [f"trust.model={of_trust}", *variant, *sets])
        assert chosen_model(config.trust_variant[0])[1].decay_per_s == decay_per_s
    same = load(None, [f"trust.model={of_trust}", "trust.decay_per_s=0.5", variant[0], "trust_variant.0.freshness_s=5"])
    assert chosen_model(same.trust_variant[0])[1].decay_per_s == 0.5
