"""Cells compute what one process computes, in every bit, whoever dies meanwhile."""

import os
import resource
import signal
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.addons.cells.border import cells_of, costs, within_reach
from cosim.addons.cells.channel import SharedChannel
from cosim.addons.cells.crew import CellLost, Crew
from cosim.addons.cells.perception import CellPerception
from cosim.addons.cells.start import NO_CELLS, Cells, in_cells
from cosim.addons.cells.worker import Worker
from cosim.addons.paper.scenarios import ScriptedScene
from cosim.config.config import load
from cosim.runs import run as running
from cosim.runs.checkpoint import encode
from cosim.runs.stop import Failed, Stopped
from cosim.step.cycle import step
from cosim.step.parts import perception_of
from cosim.step.precomputed import Precomputed
from cosim.step.state import State
from cosim.step.stopwatch import Stopwatch
from cosim.traffic.scenario import find
from results.archive import open_run, read_manifest
from results.recorder import fingerprint
from tests.drive import cosim, simulate
from tests.scene import assert_same, parts_of

N = 3
NOT_EXACT = ("gnss.std_m=0.5", "gnss.heading_std_deg=1.0")


@pytest.mark.parametrize("n_cells", [1, 2, 3, 5, 8])
def test_cells_cost_the_same_and_are_rectangles_apart(n_cells):
    rng = np.random.default_rng(n_cells)
    xy_m, cost = rng.uniform(0, 1000, (400, 2)), rng.uniform(0.5, 1.5, 400)
    cell = cells_of(xy_m, cost, n_cells)
    of_cell = np.bincount(cell, cost, n_cells)
    assert np.abs(of_cell / of_cell.mean() - 1).max() < 0.05
    for a in range(n_cells):
        for b in range(a):
            low, high = (np.stack([f(xy_m[cell == c], axis=0) for c in (a, b)]) for f in (np.min, np.max))
            assert ((low[0] > high[1]) | (low[1] > high[0])).any(), "the rectangles of two cells do not overlap"


def test_an_observer_costs_more_the_more_actors_are_around_it():
    rng = np.random.default_rng(3)
    xy_m, observers = rng.uniform(0, 1000, (400, 2)), np.arange(0, 400, 3)
    place = np.floor((xy_m - xy_m.min(axis=0)) / 80.0)
    around = np.array([(np.abs(place - place[i]).max(axis=1) <= 1).sum() for i in observers])
    own, per_actor = np.polynomial.Polynomial.fit(around, costs(xy_m, observers, 80.0), 1).convert().coef
    assert own == pytest.approx(1.0) and 0.01 < per_actor < 0.2
    far = np.array([[0.0, 0.0], [3e7, 1e7]])  # a grid of their extent would not fit into memory
    assert costs(far, np.array([0, 1]), 80.0) == pytest.approx(1.0 + per_actor)


def test_few_vehicles_take_a_cell_each_and_the_others_are_empty():
    assert sorted(cells_of(np.array([[0.0, 0], [9, 0], [5, 3]]), np.ones(3), 3)) == [0, 1, 2]
    assert len(set(cells_of(np.array([[0.0, 0], [9, 0]]), np.ones(2), 8))) == 2
    assert len(cells_of(np.zeros((0, 2)), np.zeros(0), 4)) == 0
    together = cells_of(np.zeros((8, 2)), np.ones(8), 4)  # in one place
    assert np.array_equal(np.bincount(together), [2, 2, 2, 2])


def test_all_within_reach_of_a_cell_are_there():
    xy_m = np.random.default_rng(1).uniform(0, 1000, (300, 2))
    of = np.flatnonzero((xy_m < 300).all(axis=1))
    found = within_reach(xy_m, of, 80.0)
    near = np.linalg.norm(xy_m[:, None] - xy_m[of], axis=2).min(axis=1) <= 80.0
    assert np.isin(np.flatnonzero(near), found).all() and len(found) < 300


def test_a_channel_carries_arrays_of_every_kind_and_grows():
    here, files = SharedChannel.pair()
    there = SharedChannel(files)
    for size in (0, 7, 100_000):
        sent = {"a": np.arange(size), "b": np.asfortranarray(np.ones((size, 3), np.float32)), "c": None, "d": "text"}
        here.send(sent)
        got = there.receive()
        assert_same(got, sent)
        assert got["a"].flags.writeable and got["a"].flags.aligned and got["b"].flags.f_contiguous
    here.close()
    with pytest.raises(EOFError):
        there.receive()
    there.close()


def sensed(parts, at_step=lambda number: None, ahead=False):
    """What happens in the scene with these parts, and the state at the end; `ahead`: sweeps begin a step earlier."""
    scene, state, found = ScriptedScene.load(), State.start(parts), []
    worlds = [scene.world(number) for number in range(N)]

    def begin(number):
        if ahead and number < N:
            parts.perception.begin(worlds[number], parts.sensing(worlds[number]))

    for number, world in enumerate(worlds):
        at_step(number)
        state, result = step(world, state, parts, Precomputed(sweeps_are_read=partial(begin, number + 1)))
        found.append(result.sensed)
    return found, state


def kill(pid):
    os.kill(pid, signal.SIGKILL)
    with suppress(FileNotFoundError):  # it has no parent that waits for it, and is gone
        while "State:\tZ" not in Path(f"/proc/{pid}/status").read_text():
            time.sleep(0.001)


class Dying(Crew):
    """Workers of which the first dies before some requests."""

    before = ()

    def ask(self, service, given, keeps=False):
        if service in self.before:
            kill(self.pids[0])
        return super().ask(service, given, keeps)


SCORES_OBJECTS = ("trust.model=raya_majority", "trust.host=local", "radio.evaluations=piggybacked")


@pytest.mark.parametrize("ahead", [False, True], ids=["in turn", "ahead"])
@pytest.mark.parametrize("settings", [NOT_EXACT, SCORES_OBJECTS], ids=["not exact", "scores objects"])
def test_a_scene_in_cells_is_the_scene_and_deaths_change_nothing(settings, ahead):
    parts = parts_of(ScriptedScene.load(), *settings)
    parts = replace(parts, perception=perception_of(parts.config, parts.city))  # that of the scene speaks for all
    crew = Dying(3, parts.perception)

    def deaths(number):
        crew.before = ((), ("compare", "fuse", "grouped"), ("perceived", "fuse", "grouped"))[number]
        if number == 1:
            kill(crew.pids[1])
        if number == 2:
            kill(crew._source.nursery.pid)  # and the process that forks workers
            kill(crew.pids[1])

    with crew:
        cells = CellPerception(parts.perception, crew, parts.config.lidar.max_range_m)
        found, state = sensed(replace(parts, perception=cells, compare=cells.compare), deaths, ahead)
    want, want_state = sensed(parts)
    assert_same(found, want)
    assert list(map(bytes, encode(state))) == list(map(bytes, encode(want_state)))
    assert crew.n_replaced == 6 and not crew._workers


def test_a_cell_senses_next_as_soon_as_it_has_compared():
    class Counts(Worker):
        def _sense(self, world, _):
            sensed.append(world)
            return SimpleNamespace(images=SimpleNamespace(poses=world), seen=None, watch=Stopwatch(), cpu_s=0.0)

    sensed, worker = [], Counts(None)
    worker.perceive("first", np.arange(1))
    assert worker.perceived()[0] == "first"
    worker.perceive("second", np.arange(1))
    assert sensed == ["first"], "the first sweeps have not been read"
    worker.sweeps_are_read()
    worker._perceived.result()
    assert sensed == ["first", "second"] and worker.perceived()[0] == "second"
    worker.perceive("third", np.arange(1))
    assert worker.perceived()[0] == "third", "who asks for the next sweeps has read those before"


class Dies:
    """Perception that ends its process."""

    def perceive(self, *_):
        os._exit(9)


def test_mistakes_of_workers_end_in_one_line():
    with Crew(1, Dies()) as crew:
        with pytest.raises(AttributeError, match="no attribute 'sing'"):
            crew.ask("sing", [()])
        assert crew.ask("pid", [()]) == crew.pids, "the worker lives on"
        with pytest.raises(CellLost, match=r"cell 0 died 8 times over one request \(out of memory\?\)$"):
            crew.ask("perceive", [(None, np.zeros(0))])


def test_too_many_cells_end_in_one_line_and_write_nothing(tmp_path):
    ended = cosim("run", "--cells", "68", "--out", str(tmp_path / "run"))
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
    assert "helsinki is too small: 1039 m x 1663 m, and a LiDAR reaches 80 m" in ended.stderr


@pytest.mark.parametrize(("n_cells", "key", "says"), [(400, "seed=1", "1 to 256"), (2, "sensing=false", "nothing to")])
def test_wrong_numbers_of_cells(n_cells, key, says):
    parts = parts_of(ScriptedScene.load())
    parts = replace(parts, config=load(None, [key]))
    with pytest.raises(ValueError, match=says), in_cells(parts, find("helsinki", None), Cells(n_cells)):
        pass


@pytest.mark.parametrize("text", ["-1", "257", "1.5", "many", "", "²"])
def test_what_is_no_number_of_cells(text):
    with pytest.raises(ValueError, match="give a number from 1 to 256, auto, or 0 for none"):
        Cells.of(text)


def test_auto_takes_no_cells_where_nothing_is_sensed():
    parts = parts_of(ScriptedScene.load())
    parts = replace(parts, config=load(None, ["sensing=false"]))
    with in_cells(parts, find("helsinki", None), Cells("auto")) as same:
        assert same is parts
    assert Cells.of("3") == Cells(3) and Cells.of("0") == NO_CELLS


def test_no_memory_for_a_message_is_an_error_of_the_run_and_no_death():
    """A limit on the size of files stands for memory that is full: the run hears of it before it writes a byte."""
    with Crew(1, Dies()) as crew:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, hard))
        try:
            with pytest.raises(OSError, match="too large"):
                crew.ask("pid", [(np.zeros(1 << 16),)])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert crew.n_replaced == 0


class NeverArrives:
    """Perception that ends the process that unpacks it."""

    def __reduce__(self):
        return os._exit, (9,)


@pytest.mark.verify
def test_workers_that_cannot_be_started_end_in_one_line():
    with pytest.raises(Failed, match=r"cannot be started \(out of memory or processes\?\). Nothing was written"):
        Crew(2, NeverArrives()).__enter__()


SHORT = ("traffic.duration_s=6", "traffic.warmup_s=60", "record.level=full")
ALL_ON = (
    "preset=modern", *SHORT, "record.block_steps=4", "attacks.0.start_s=0", "attacks.0.share_p=0.3",
    "attacks.1.start_s=0", "attacks.1.share_p=0.2", "trust.host=local", "pseudonyms.policy=c2c",
    "driver.model=cautious", "fleet.penetration_p=1", "gnss.std_m=0.5",
)  # fmt: skip


@pytest.mark.verify
@pytest.mark.parametrize("settings", [("preset=v0.2", *SHORT), ALL_ON], ids=["v0.2", "all on"])
@pytest.mark.parametrize("n_cells", [1, 2, 4, 8])
def test_a_run_in_cells_has_the_same_tables(n_cells, settings, tmp_path):
    words = [word for key in settings for word in ("--set", key)]
    ended = cosim("run", *words, "--cells", str(n_cells), "--out", str(tmp_path / "cells"))
    assert ended.returncode == 0, ended.stderr
    assert fingerprint(tmp_path / "cells") == fingerprint(simulate(tmp_path / "one", *settings))
    assert read_manifest(tmp_path / "cells")["cells"]["cells"] == n_cells


QUIET = ("record.block_steps=5", "attacks.0.start_s=0", "seed=3")


def test_steps_in_which_nobody_senses_and_a_resumed_run(tmp_path):
    """With random phases and few equipped vehicles, most steps have no sweep. Interrupted, and resumed in cells."""
    quiet = ("preset=modern", "traffic.duration_s=6", "traffic.warmup_s=60", "fleet.penetration_p=0.02", *QUIET)
    words = [word for key in quiet for word in ("--set", key)]
    ended = cosim("run", *words, "--cells", "1", "--out", str(tmp_path / "cells"))
    assert ended.returncode == 0, ended.stderr
    one = simulate(tmp_path / "one", *quiet)
    assert fingerprint(tmp_path / "cells") == fingerprint(one)
    sensing = open_run(one).table("detections", ["step"]).step.unique()
    assert 0 < len(sensing) < 25, "of 30 steps"
    config = load(None, list(quiet))

    def interrupted(phase, done, *_):
        if phase == "run" and done == 12:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Stopped):
        running.run(config, tmp_path / "part", interrupted)
    ended = cosim("resume", str(tmp_path / "part"), "--cells", "1")
    assert ended.returncode == 0, ended.stderr
    assert fingerprint(tmp_path / "part") == fingerprint(one)
