"""The helper compiles what a run needs and nothing else, keeps what others cached, and ends with the run."""

import json
import os
import subprocess
import sys
import time

import psutil
import pytest
from numba.core import event

from cosim.config.config import load
from cosim.execution.speed.compile_ahead import _COMPILES, _FEW, CompileAhead
from tests.drive import SHORT

FIRST = (
    "cosim.mobility.", "sensors.raycast.", "sensors.range_image.", "sensors.range_noise.", "sensors.range_steps.",
    "sensors.thinned.", "sensors.false_positives.", "sensors.hash_rng.", "sensors.box_points.", "sensors.pairs.",
    "sensors.lanes.",
)  # fmt: skip
"""Traffic, sweeps and detector: what a run compiles itself meanwhile."""

SIGNATURES = """
import json, sys
from numba.core.dispatcher import Dispatcher
from cosim.config.config import load
config = load(None, sys.argv[2:])
{what}
found = set()
for module in [m for name, m in sys.modules.items() if name.split(".")[0] in ("cosim", "sensors", "trust", "results")]:
    for one in vars(module).values():
        if isinstance(one, Dispatcher):
            name = f"{{one.py_func.__module__}}.{{one.py_func.__name__}}"
            found |= {{f"{{name}} {{signature}}" for signature in one.signatures}}
print(json.dumps(sorted(found)))
"""
"""Prints every kernel that was called in a process, with the types of its arguments."""
COMPILE = "from cosim.execution.speed.compile_ahead import compile_all; compile_all(config)"
RUN = """
from pathlib import Path
from cosim.execution import run
from results.archive import open_run
from results.metrics import lookups
folder = Path(sys.argv[1])
run.run(config, folder, lambda *_: None)
lookups.sums(open_run(folder))
"""
"""A run, and what its summary needs of kernels."""


def signatures(what: str, folder, *overrides: str) -> set[str]:
    command = [sys.executable, "-c", SIGNATURES.format(what=what), str(folder), *overrides]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param((), id="default"),
        pytest.param(("trust.host=local", "radio.cpm_rules=etsi"), id="local trust"),
    ],
)
def test_kernels_are_those_of_a_run(tmp_path, overrides):
    overrides = (*SHORT, "trust.freshness_s=5", *overrides)
    for _ in range(2):  # what is not cached yet is compiled with all that it calls, which does not count
        ahead = signatures(
            "from cosim.execution.speed.compile_ahead import compile_all; compile_all(config)", "", *overrides
        )
    needed = signatures(RUN, tmp_path / "run", *overrides)
    assert not ahead - needed
    assert not {one for one in needed - ahead if not one.startswith(FIRST)}


def begun(*overrides: str) -> CompileAhead:
    """The helper of a run with this config that has compiled a few kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("numba.get_num_threads", lambda: 2)
        ahead = CompileAhead(load(None, list(overrides)))
    with pytest.MonkeyPatch.context() as patch:  # Numba compiles nothing here
        patch.setattr(
            "numba.core.event.register", lambda kind, listener: [listener.on_start(None) for _ in range(_FEW)]
        )
        ahead.__enter__()
    if ahead._may:
        event.register(_COMPILES, ahead)
    return ahead


def test_the_helper_ends_with_the_run():
    ahead = begun()
    assert ahead._helper.poll() is None
    ahead.__exit__(None, None, None)
    assert ahead._helper.poll() is not None


def test_the_helper_ends_where_the_run_is_killed(tmp_path):
    program = (
        "import sys, time; from tests.cosim.execution.test_compile_ahead import begun;"
        "print(begun()._helper.pid, flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as run:
        helper = psutil.Process(int(run.stdout.readline()))
        run.kill()
    end_s = time.monotonic() + 30
    while is_alive(helper) and time.monotonic() < end_s:
        time.sleep(0.1)
    assert not is_alive(helper)


def is_alive(process: psutil.Process) -> bool:
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


@pytest.mark.parametrize("key", ["compute.threads=1", "sensing=false", "trust.model=tests.parts:HostileMessages"])
def test_no_helper_where_it_would_not_help(key):
    assert begun(key)._helper is None


def test_a_helper_that_cannot_be_started_is_done_without(monkeypatch):
    def refuse(*_, **__):
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    ahead = begun()
    assert ahead._helper is None
    ahead.__exit__(None, None, None)


KERNEL = """
from numba import njit

@njit(cache=True)
def twice(x):
    return x + x
"""


def test_a_kernel_that_the_helper_saves_is_loaded(tmp_path):
    """And what another process has saved of the same kernel stays."""
    (tmp_path / "kernels.py").write_text(KERNEL)
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": f"{tmp_path}:{os.getcwd()}"}

    def call(value: str, saves: str = "Cache.save") -> str:
        program = (
            "from cosim import compile_ahead; from numba.core.caching import IndexDataCacheFile as Cache;"
            f"Cache.save = {saves}; from kernels import twice; twice({value}); print(twice.stats)"
        )
        return subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True).stdout

    assert "cache_misses=Counter({(int64,): 1})" in call("1")
    assert "cache_misses=Counter({(float64,): 1})" in call("1.0", "compile_ahead._save")
    assert "cache_hits=Counter({(int64,): 1})" in call("1")
    assert "cache_hits=Counter({(float64,): 1})" in call("1.0")
    assert len(list((tmp_path / "cache").rglob("*.nbc"))) == 2
