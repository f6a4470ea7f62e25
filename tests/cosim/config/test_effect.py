"""A key without effect is said to have none, and nothing else is."""

from dataclasses import fields

import pytest

from cosim.attacks.params import AttackParams
from cosim.config.config import Config, load
from cosim.config.effect import _NEEDS, _RULES, _needs, _vain, without_effect
from cosim.config.preset import names
from cosim.traffic.roadside import RoadsideParams


def said(*sets, is_replayed=False):
    return without_effect(load(None, ["preset=modern", *sets]), is_replayed)


@pytest.mark.parametrize("name", names())
def test_a_preset_has_no_key_in_vain(name):
    assert without_effect(load(None, [f"preset={name}"]), True) == []


@pytest.mark.parametrize(
    ("sets", "line"),
    [
        ("parked.vans_p=0.5", "parked.vans_p has no effect without parked.per_100_m above 0."),
        ("trees.height_m=5", "trees.height_m has no effect without trees.per_100_m or trees.from_map."),
        ("weather.known=false",
         "weather.known has no effect without weather.visibility_m or weather.rain_mm_h above 0."),
        ("weather.clear_range_m=200 weather.sun=[90,20,0.5]",
         "weather.clear_range_m has no effect without weather.visibility_m or weather.rain_mm_h above 0."),
        ("detector.model=ideal detector.flip_p=0.1",
         'detector.flip_p has no effect without another detector.model than "ideal".'),
        ("weather.dirty_p=0.5", "weather.dirty_p has no effect without weather.dirt."),
        ("radio.nr.mcs=5", 'radio.nr.mcs has no effect without radio.model = "nr_mode2".'),
        ("radio.model=nr_mode2 radio.receiver.rate_mbps=12 radio.receiver.noise_figure_db=9",
         'radio.receiver.rate_mbps has no effect without radio.model = "csma".'),
        ("radio.model=lte_mode4 radio.receiver.p_min_dbm=-82",
         'radio.receiver.p_min_dbm has no effect without radio.model = "csma", or jammers, which detect frames by it.'),
        ("radio.receiver.capture_margin_db=3",
         "radio.receiver.capture_margin_db has no effect without radio.receiver.capture = true."),
        ("radio.model=nr_mode2 radio.dcc.period_s=0.2",
         'radio.dcc.period_s has no effect without radio.model = "csma".'),
        ("tracking.model=none tracking.keep_s=9 tracking.gate_p=0.9",
         'tracking.gate_p, tracking.keep_s have no effect without tracking.model = "constant_velocity".'),
        ("preset=v0.2 extrapolate=true",
         "extrapolate has no effect without vehicles that sense at different times."),
        ("trust.model=beta trust.freshness_s=20",
         'trust.freshness_s has no effect without a trust.model that reads it, such as "trupercept" '
         "(freshness.capped_age alone follows it)."),
        ("sensing=false trust.tau=0.3", "trust.tau has no effect without sensing = true."),
        ("trust.matching=iou attacks.0.attack=misstated_accuracy",
         'attacks.0.attack = "misstated_accuracy" has no effect without trust.matching = "gates".'),
        ("attacks.0.active_p=0.3", 'attacks.0.active_p has no effect without when = "sporadic".'),
        ("roadside.0.at=[500,500] roadside.0.choose=random",
         "roadside.0.choose has no effect without junctions = N."),
    ],
)  # fmt: skip
def test_keys_in_vain(sets, line):
    assert said(*sets.split()) == [line]


def test_a_variant_s_key_that_its_model_does_not_read():
    """A beta model has no window, whatever the model of [trust] reads; a variant says nothing of keys it leaves."""
    window = "trust_variant.0.name=paper", "trust_variant.0.freshness_s=3"
    line = 'trust_variant.0.freshness_s has no effect without a trust.model that reads it, such as "trupercept" '
    for sets in (["trust.model=beta", *window], [*window, "trust_variant.0.model=beta"]):
        assert said(*sets) == [line + "(freshness.capped_age alone follows it)."]
    assert said(*window) == []
    assert said("trust.freshness_s=3", *window, "trust_variant.0.model=beta") == []


def test_a_key_that_turns_off_others_has_an_effect():
    needs = _needs("config", load(None, ["preset=modern", "tracking.model=none"]))
    assert _vain(["tracking.model"], needs) == []
    (line,) = _vain(["tracking.keep_s", "tracking.model"], needs)
    assert line.startswith("tracking.keep_s has no effect without tracking.model")


def test_traffic_that_is_replayed_has_its_own_demand():
    assert said("traffic.scale=2") == []
    assert said("traffic.scale=2", is_replayed=True) == [
        "traffic.scale has no effect without SUMO (traffic is replayed)."
    ]


@pytest.mark.parametrize(
    "sets",
    [
        "parked.per_100_m=3 parked.vans_p=0.5",
        "radio.model=nr_mode2 radio.nr.mcs=5",
        "radio.model=lte_mode4 radio.sidelink.reselect_after=2 radio.lte.mcs=5",
        "cpm.rules=etsi cpm.interval_s=0.5",
        "attacks.0.when=on_off attacks.0.duty_p=0.2",
        "extrapolate=false",
        "trust.server_period_s=3",
        "trust.host=local trust.local_evidence=own",
        "roadside.0.junctions=2 roadside.0.choose=random",
    ],
)
def test_keys_with_an_effect(sets):
    assert said(*sets.split()) == []


def test_the_table_names_keys_that_exist():
    known = set(_names(Config, ""))
    for need in _NEEDS["config"]:
        for key in need["keys"]:
            assert any(name == key or (key.endswith("*") and name.startswith(key[:-1])) for name in known), key
    for section, of in (("attacks", AttackParams), ("roadside", RoadsideParams)):
        assert {key for need in _NEEDS[section] for key in need["keys"]} <= {f.name for f in fields(of)}
    conditions = [condition for needs in _NEEDS.values() for need in needs for condition in need["if"]]
    assert {condition["rule"] for condition in conditions if "rule" in condition} == _RULES.keys()
    for condition in conditions:
        assert condition.keys() in ({"rule"}, {"key", "is"}, {"key", "is_not"}, {"key", "above"}), condition


def _names(of, prefix):
    for f in fields(of):
        yield prefix + f.name
        inner = f.type if hasattr(f.type, "__dataclass_fields__") else None
        if inner is None and f.name in ("attacks", "roadside", "sensing_groups"):
            yield f"{prefix}{f.name}."
        if inner is not None:
            yield from _names(inner, f"{prefix}{f.name}.")
