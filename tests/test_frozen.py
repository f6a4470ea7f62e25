"""Small worlds compute what they computed when `golden/frozen.json` was written, bit for bit.

Where a change is meant to move something, renew the file, and say in CHANGELOG.md what moved and why.
"""

import pandas as pd
import pytest

from tests import frozen

WORLDS = frozen.worlds()
SLOW = {name: () if world.quick else pytest.mark.verify for name, world in WORLDS.items()}


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW[name]) for name in WORLDS])
def test_nothing_moved(name):
    world, record = WORLDS[name], frozen.recorded()
    if not world.is_possible:
        pytest.skip(f"{world.module} is not installed")
    was, now = record["worlds"][name], frozen.simulated(world)
    assert not now["idle"], f"{name}: features that did not act: no row of {now['idle']}"
    moved = [*frozen.moved_tables(was, now), *frozen.moved_metrics(was, now)]
    if not (other := frozen.other_platform(record["platform"])):
        assert not moved, _message(name, moved)
    elif moved:
        far = frozen.moved_metrics(was, now, frozen.LOOSE, frozen.LOOSE)
        n = sum(map(len, was["metrics"].values()))
        assert len(far) <= frozen.OUTLIERS_P * n, _message(name, far)
        pytest.skip(f"bitwise part, {len(moved)} moved: frozen.json is of another platform ({other})")


def _message(name: str, moved: list[str]) -> str:
    lines = "\n  ".join(moved)
    return f"{name}: {len(moved)} moved\n  {lines}\nIf that is meant, renew the file: {frozen.COMMAND} {name}"


def test_every_world_is_recorded():
    assert set(frozen.recorded()["worlds"]) == set(WORLDS), f"Renew the file: {frozen.COMMAND}"


@pytest.mark.parametrize("name", [name for name, world in WORLDS.items() if world.moves])
def test_a_feature_moves_what_it_acts_on(name):
    """Weather, trees and the like have no table of their own: they change those of the world without them."""
    found = frozen.recorded()["worlds"]
    for table in WORLDS[name].moves:
        assert found[name]["tables"][table]["all"] != found[WORLDS[name].on]["tables"][table]["all"], table


def test_what_a_fingerprint_depends_on():
    """Order of rows, sign of zero: nothing. Values, which values share a row, types, names: all."""
    rows = pd.DataFrame({"a": [1, 2, 3], "b": [0.0, 0.5, float("nan")]})
    was = frozen.fingerprint(rows)
    assert frozen.fingerprint(rows.iloc[::-1]) == was == frozen.fingerprint(rows.assign(b=-1 * -rows.b).iloc[[1, 0, 2]])
    assert frozen.fingerprint(rows[["b", "a"]].replace({"b": {0.0: -0.0}})) == was
    swapped = frozen.fingerprint(rows.assign(b=rows.b.to_numpy()[[1, 0, 2]]))
    assert (swapped["a"], swapped["b"]) == (was["a"], was["b"]) and swapped["all"] != was["all"]
    for other in (rows.assign(a=rows.a + 1), rows.astype({"b": "float32"}), rows.iloc[:2]):
        assert frozen.fingerprint(other)["all"] != was["all"]


def test_metrics_that_moved():
    was = {"metrics": {"trust": {"honest": 0.5, "malicious": 0.25}, "n": {"": 3.0}}}
    now = {"metrics": {"trust": {"honest": 0.5 + 1e-12, "malicious": 0.26}, "m": {"": 3.0}}}
    assert frozen.moved_metrics(was, now) == [
        "metric trust | malicious: 0.25 -> 0.26", "metric n | : 3 -> nan", "metric m | : nan -> 3",
    ]  # fmt: skip
    assert len(frozen.moved_metrics(was, now, 0.05)) == 2
