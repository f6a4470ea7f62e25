"""A simulation in memory shows what a run records."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import cosim
from cosim import Simulation
from cosim.config.config import load
from trust.models.trupercept import TruPercept

SHORT = ["traffic.duration_s=3", "trust.server_period_s=1", "attacks.0.start_s=1"]
TABLES = ("detections", "evaluations", "trust", "trust_lookups", "fused")


class Halved(TruPercept):
    """Trust that is half of TruPercept's: a class of a user's own."""

    def scores(self, step=None):
        """As TruPercept, halved."""
        found = super().scores(step)
        found.trust[:] /= 2
        return found


@pytest.fixture(scope="module")
def steps():
    """What the first steps of the shipped city show, while they are simulated."""
    with Simulation(load(None, SHORT)) as simulation:
        return [
            {name: getattr(result, name) for name in (*TABLES, "step", "time_s", "messages", "vehicles")}
            | {"sensor": result.cloud(result.vehicles[0], "sensor"), "world": result.cloud(result.vehicles[0])}
            for result in simulation
        ]


def test_tables_are_those_of_a_run(steps, tmp_path):
    run = cosim.run(load(None, [*SHORT, "record.level=full"]), tmp_path / "run")
    assert [found["step"] for found in steps] == [0, 1, 2] and [found["time_s"] for found in steps] == [0.0, 1.0, 2.0]
    for name in TABLES:
        want, found = getattr(run, name), pd.concat([found[name] for found in steps], ignore_index=True)
        assert set(found.columns) == set(want.columns) and len(found) == len(want) > 0, name
        keys = [c for c in want.columns if want[c].dtype.kind in "iu" and found[c].notna().all()]
        pd.testing.assert_frame_equal(
            found.sort_values(keys, ignore_index=True)[list(want.columns)].astype(want.dtypes.to_dict()),
            want.sort_values(keys, ignore_index=True), rtol=1e-2, atol=1e-2,
        )  # fmt: skip
    assert sum(len(found["messages"]) for found in steps) == len(run.receptions)


def test_clouds(steps):
    """The sensor looks along the heading, some two metres above the street."""
    for found in steps:
        sensor, world = found["sensor"], found["world"]
        assert sensor.shape == world.shape and sensor.shape[1] == 3 and len(sensor) > 1000
        np.testing.assert_allclose(np.ptp(sensor[:, 2]), np.ptp(world[:, 2]))
        apart = np.linalg.norm(np.diff(sensor[:100], axis=0), axis=1)
        np.testing.assert_allclose(apart, np.linalg.norm(np.diff(world[:100], axis=0), axis=1), atol=1e-6)


def test_with_random_phases_each_vehicle_senses_once_per_interval():
    """Five steps are an interval. Whoever senses has a cloud; whoever does not is told so."""
    data = {"preset": "modern", "traffic": {"duration_s": 1, "warmup_s": 120}, "roadside": [{"junctions": 1}]}
    with Simulation(data) as simulation:
        sensed = []
        for step in simulation:
            sensed += step.sensing.tolist()
            assert len(step.cloud(step.sensing[0])) > 1000
            (silent, *_) = np.setdiff1d(step.vehicles, step.sensing)
            with pytest.raises(ValueError, match=r"has no sweep in step \d: name one of step\.sensing"):
                step.cloud(silent)
    assert len(sensed) == len(set(sensed))
    assert 0.8 < len(sensed) / len(step.vehicles) < 1.2
    of_vehicles = step.world.actor[step.world.equipped & ~step.world.is_roadside]
    assert step.table("position_errors").vehicle.tolist() == of_vehicles.tolist()
    assert len(step.vehicles) > len(of_vehicles)
    with pytest.raises(ValueError, match="a step has no table 'encounters'"):
        step.table("encounters")


def test_a_class_in_place_of_a_part_and_clouds_of_the_past():
    data = {"traffic": {"duration_s": 2}, "trust": {"server_period_s": 1}, "attacks": []}
    with Simulation(data, trust=Halved) as simulation:
        first = next(simulation)
        second = next(simulation)
        assert second.trust.trust.max() <= 0.5 and len(second.trust)
        with pytest.raises(ValueError, match="frame = 'sensr': there is no such choice"):
            second.cloud(second.vehicles[0], "sensr")
        with pytest.raises(RuntimeError, match="clouds of step 0 are gone"):
            first.cloud(first.vehicles[0])
        with pytest.raises(ValueError, match="vehicle 999999 has no sweep"):
            second.cloud(999999)
        with pytest.raises(StopIteration):
            next(simulation)
    assert first.trust.empty and len(second.trust)
    for name in ("trust", "fused", "detections", "trust_lookups"):
        both = pd.concat([getattr(first, name), getattr(second, name)])
        assert object not in set(both.dtypes), name
    with simulation:
        assert len(list(simulation)) == 2  # all steps once more


@pytest.mark.parametrize(("parts", "message"), [
    ({"wheels": Halved}, "no such part"),
    ({"trust": Halved(load().trust, 1.0)}, "no class at the top level"),
])  # fmt: skip
def test_mistakes(parts, message):
    with pytest.raises(ValueError, match=message):
        Simulation(None, **parts)


@pytest.mark.parametrize(("config", "message"), [
    ([3], "the config is a list. Give a dictionary"),
    ("seed = 3\n[traffic]\nduration_s = 5", "text of several lines: `tomllib.loads"),
    (".", r"\. is a folder. Give a dictionary"),
])  # fmt: skip
def test_what_is_no_config(config, message):
    with pytest.raises(ValueError, match=message):
        Simulation(config)


def test_a_dictionary_may_hold_numbers_of_numpy_tuples_and_paths():
    """seed = numpy.int64(7) was refused as '7', which should be a valid integer."""
    attacks = ({"attack": "ghost_insertion", "share_p": np.float32(0.25)},)
    given = {"seed": np.int64(7), "traffic": {"duration_s": np.arange(2, 4)[0]}, "attacks": attacks}
    config = Simulation(given).config
    assert (config.seed, config.traffic.duration_s, config.attacks[0].share_p) == (7, 2, 0.25)
    assert given["attacks"] is attacks


def test_a_config_is_checked_as_a_dictionary_is():
    """With a class in place of a part it was refused, and what `replace` had put into it was taken as it came."""
    assert Simulation(load(), trust="beta").config.trust.model == "beta"
    assert Simulation(load()).config == load(None, f"seed={load().seed}")
    with pytest.raises(ValueError, match=r"seed = 1\.5 should be a valid integer"):
        Simulation(replace(load(), seed=1.5))


def test_keys_without_effect_are_named(caplog):
    Simulation({"parked": {"vans_p": 0.5}})
    assert "parked.vans_p has no effect without parked.per_100_m above 0." in caplog.text


def test_one_enters_before_one_iterates():
    with pytest.raises(RuntimeError, match="entered before"):
        next(Simulation(load()))


def test_the_namespace_is_small_and_quick():
    assert {"Simulation", "run", "open_run", "__version__"} <= set(dir(cosim))
    code = "import cosim, sys; assert not {'numpy', 'pandas', 'numba'} & set(sys.modules), 'light'"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'walk'"):
        cosim.walk  # noqa: B018
