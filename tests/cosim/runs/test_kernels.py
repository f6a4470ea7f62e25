"""A second process compiles kernels while a run compiles others."""

import os
import signal
import subprocess
import sys
import time

import pytest

from cosim.runs import process
from cosim.runs.speed.kernels import kernel_of, listed, types_of
from tests.kernels import text_of
from tests.slow import slow

SAY = "from cosim.runs.speed.kernels import compiling\nwith compiling({}) as child:\n    print(child and child.pid)\n"
WAIT = "    import time; time.sleep(60)\n"


def started(tmp_path, code, **more):
    """A process with a second core and an empty cache."""
    environment = process.environment(NUMBA_CACHE_DIR=str(tmp_path), NUMBA_NUM_THREADS="2") | more
    words = [sys.executable, "-u", "-c", code]
    return subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ends(pid):
    """Whether a process ends within ten seconds."""
    for _ in range(1000):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


def test_the_list_names_kernels_and_types():
    """`python -m tests.kernels` writes it anew."""
    kernels = listed()
    assert len(kernels) > 40
    for module, name, text in kernels:
        of = types_of(text)
        assert kernel_of(module, name).py_func.__code__.co_argcount == len(of)
        assert f"({', '.join(map(text_of, of))},)" == text


def test_the_process_ends_with_the_block(tmp_path):
    out, err = started(tmp_path, SAY.format(0)).communicate()
    assert ends(int(out)) and not err


def test_the_process_ends_with_a_killed_run(tmp_path):
    run = started(tmp_path, SAY.format(0) + WAIT)
    child = int(run.stdout.readline())
    os.kill(child, 0)
    second = started(tmp_path, SAY.format(0))
    assert second.communicate() == ("None\n", ""), "one compiles at a time"
    run.send_signal(signal.SIGKILL)
    run.communicate()
    assert ends(child)


@pytest.mark.parametrize(
    ("n_threads", "more"),
    [
        (0, {"NUMBA_DISABLE_JIT": "1"}),
        slow(1, {}),
        slow(0, {"NUMBA_NUM_THREADS": "1"}),
    ],
)
def test_no_process_where_there_is_nothing_to_gain(tmp_path, n_threads, more):
    out, err = started(tmp_path, SAY.format(n_threads), **more).communicate()
    assert (out, err) == ("None\n", "")


@pytest.mark.verify
def test_an_old_list_does_no_harm_and_is_gone_through_once(tmp_path):
    """The second kernel and the types of the third are gone."""
    first = " ".join(listed()[0])
    cheap = "trust.open_steps _no_such_kernel (int64,)"
    path = tmp_path / "list.txt"
    path.write_text(f"{first}\n{cheap}\ntrust.open_steps OpenSteps (named('trust', 'Gone', int64),)\n")
    code = SAY.format(f"0, Path({str(path)!r})") + "    child and child.wait()\n"
    code = "from pathlib import Path\n" + code
    out, err = started(tmp_path, code).communicate()
    assert int(out) and not err
    module, name, _ = listed()[0]
    assert [*tmp_path.rglob(f"{module.split('.')[-1]}.{name}-*.nbc")]
    assert started(tmp_path, code).communicate() == ("None\n", "")
