"""Runs for tests: each in a process of its own, as a user's are.

The processes are children of one that has imported the program already, which takes less than half of the time.
"""

import errno
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from cosim.config.config import load
from cosim.runs.check import check, notes_on
from tests.processes import Ended, set_words, warm

SHORT = (
    "traffic.duration_s=20",
    "traffic.warmup_s=120",
    "attacks.0.start_s=5",
    "attacks.0.share_p=0.2",
    "attacks.1.start_s=5",
    "attacks.1.share_p=0.2",
)
"""Twenty seconds of the shipped city after two minutes of traffic, long enough for every attack to begin."""


def cosim(*words: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess:
    """`cosim` with these words on its command line, and these variables beside those of the tests."""
    ended = carried_out(*words, cwd=cwd, **environment)
    return subprocess.CompletedProcess(words, ended.status, ended.out, ended.err)


def assert_refused(done: subprocess.CompletedProcess, says: str = "") -> None:
    """Status 2, and one line that says this."""
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done
    assert says in done.stderr, done.stderr


def python(code: str, *words: str, cwd: Path | None = None) -> str:
    """What `python -c CODE WORDS` prints, in a process of its own."""
    ended = carried_out("python", code, *words, cwd=cwd)
    assert ended.status == 0 and not ended.err, ended.err
    return ended.out


def drive(folder: Path, *overrides: str, config: Path | None = None) -> Path:
    """A short run of the shipped city, or one of a config, into `folder`; overrides may name parts of `tests.parts`.

    It has the tables of `cosim run`, which also measures and draws.
    """
    return simulate(folder, *(() if config else SHORT), *overrides, config=config)


def simulate(folder: Path, *overrides: str, config: Path | None = None) -> Path:
    """A run with these overrides alone."""
    sets = set_words(overrides)
    ended = carried_out("simulate", *([str(config)] if config else []), *sets, "--out", str(folder))
    assert ended.status == 0, ended.err
    return folder


def full_disk(*_: object) -> None:
    """Writes nothing, because the disk is full."""
    raise OSError(errno.ENOSPC, "No space left on device")


def noted(*overrides: str) -> list[str]:
    """Notes on the default config with these overrides, as before a run."""
    config = load(None, list(overrides))
    return notes_on(config, check(config))


def carried_out(*words: str, cwd: Path | None = None, **environment: str) -> Ended:
    """A command without limits of time and memory."""
    with tempfile.TemporaryDirectory(prefix="cosim-test-") as place:
        return warm()(
            *words, cwd=cwd or Path.cwd(), cpu_s=None, place=Path(place), environment=environment
        )  # fmt: skip


IN_TURN = """
import json, os, sys
import cosim.runs.run
from cosim.cli.main import main
for number, words in enumerate(json.loads(sys.argv[1])):
    if not os.fork():
        for stream, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"{sys.argv[2]}/{number}.{name}", os.O_WRONLY | os.O_CREAT), stream)
        sys.argv = ["cosim", *words]
        sys.exit(main())
    print(os.waitstatus_to_exitcode(os.wait()[1]), flush=True)
"""


def in_turn(*commands: list[str], cwd: Path, before: str = "", **environment: str) -> list[subprocess.CompletedProcess]:
    """`cosim` with the words of each command, in children of one new process, which first carries out some code.

    A process of its own for each command would import the program anew.
    """
    with tempfile.TemporaryDirectory(prefix="cosim-test-") as streams:
        words = [sys.executable, "-c", before + IN_TURN, json.dumps(commands), streams]
        variables = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])} | environment
        ended = subprocess.check_output(words, cwd=cwd, env=variables, text=True).split()
        return [
            subprocess.CompletedProcess(
                command, int(status), *(Path(streams, f"{n}.{name}").read_text() for name in ("out", "err"))
            )
            for n, (command, status) in enumerate(zip(commands, ended, strict=True))
        ]
