"""Damaged run folders: every harm is found by `verify`, and no metric or figure comes of it unsaid."""

import random
import shutil
from collections import Counter

import pytest

from cosim.base.durable import Damaged
from results.archive import open_run
from results.measure import measure
from results.verify import verify
from tests.hostile import SEED, N
from tests.hostile.folders import HARMS
from tests.results.synthetic import write


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that is whole."""
    folder = write(tmp_path_factory.mktemp("whole") / "run", steps=40, block_steps=10)
    (folder / "config.toml").write_text("")
    assert verify(folder)[1] == []
    return folder


def found(folder):
    """Problems beyond the config that a made-up run does not have."""
    return [problem for problem in verify(folder)[1] if not problem.startswith("config.toml")]


@pytest.mark.parametrize("harm", sorted(set(HARMS), key=lambda h: h.__name__), ids=lambda h: h.__name__)
def test_each_harm_is_found(whole, tmp_path, harm):
    shutil.copytree(whole, tmp_path / "run")
    said = harm(tmp_path / "run", random.Random(3))
    assert found(tmp_path / "run"), said


@pytest.mark.verify
def test_generated(whole, tmp_path):
    counts, missed = Counter(), []
    for number in range(5 * N):
        rng = random.Random(SEED * 1_000_003 + number)
        folder = tmp_path / "run"
        shutil.copytree(whole, folder)
        harm = rng.choice(HARMS)
        said = harm(folder, rng)
        counts[harm.__name__] += 1
        if not found(folder):
            missed.append(f"{number}: {said}")
        shutil.rmtree(folder)
    print(f"\ndamaged folders, seed {SEED}: {dict(counts)}, {len(missed)} missed of {5 * N}")
    assert not missed, "\n".join(missed)


def measured(run):
    """Values by metric and group, without what could not be measured."""
    values = measure(run).set_index(["metric", "group"]).value
    return values[~values.index.get_level_values(0).str.endswith("not_measured")]


@pytest.mark.verify
def test_no_figure_out_of_damage(whole, tmp_path):
    """Metrics of a damaged run equal those of the whole one, or their topic says what is damaged."""
    want = measured(open_run(whole))
    counts: Counter = Counter()
    for number in range(max(10, N // 10)):
        rng = random.Random(SEED * 7919 + number)
        folder = tmp_path / "run"
        shutil.copytree(whole, folder)
        said = rng.choice(HARMS)(folder, rng)
        try:
            run = open_run(folder)
            kept = measured(run)
        except Damaged:
            counts["refused"] += 1
        except ValueError:
            counts["refused for another reason"] += 1
        else:
            assert kept.equals(want.loc[kept.index]), said
            assert len(kept) == len(want) or run.damage, said
            counts["said" if run.damage else "untouched"] += 1
        shutil.rmtree(folder)
    print(f"\nmetrics of damaged folders, seed {SEED}: {dict(counts)}")
