"""Commands in children of one warm process: a whole `cosim run` of a few steps in a fraction of a second.

`Warm` starts `python -m tests.processes`, which imports the program, makes one run of a trace so that all kernels are
loaded, and then forks a child for every command that it reads. A child has files as standard streams and a temporary
folder of its own, so that what it leaves behind is seen; where asked, it has a limit on processor time and memory.
"""

import atexit
import gc
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

MEMORY_BYTES = 6 << 30
"""Address space that a child may take beyond that of the warm process."""
XCPU = signal.SIGXCPU


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended."""

    status: int
    """Exit status; negative for a signal."""
    out: str
    err: str
    cpu_s: float
    left: list[str] = field(default_factory=list)
    """What it left in its temporary folder."""

    @property
    def wrong(self) -> str:
        """Why no user should ever see this; empty where it is well-behaved."""
        if self.status == -XCPU:
            return f"no end within {self.cpu_s:.0f} s of processor time"
        if self.status < 0:
            return f"signal {signal.Signals(-self.status).name}"
        if "Traceback" in self.err:
            return "traceback: " + self.err.strip().splitlines()[-1]
        if self.status not in (0, 1, 2, 130, 143):
            return f"status {self.status}"
        if self.status in (1, 2) and not (self.err.startswith("error: ") and self.err.count("\n") == 1):
            return f"status {self.status} with {self.err.count(chr(10))} lines: {self.err[:200]!r}"
        if self.left:
            return f"left behind: {self.left}"
        return "warning: " + self.err[:200] if "Warning" in self.err else ""


class Warm:
    """Runs commands; a context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __enter__(self) -> "Warm":
        environment = os.environ | {"PYTHONWARNINGS": "default"}
        environment.pop("COLUMNS", None)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.processes", str(self.folder)], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, text=True, env=environment, cwd=Path(__file__).parents[1],
        )  # fmt: skip
        assert self._said() == "ready", "the warm process did not start"
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def __call__(
        self, *words: str, cwd: Path, cpu_s: float | None = 10.0, environment: dict[str, str] | None = None,
        place: Path | None = None, **more: Any,
    ) -> Ended:  # fmt: skip
        """`cosim WORDS`; `simulate` is `run` without its metrics and its picture, at a third of the cost.

        `python CODE WORDS` is `python -c CODE WORDS`. `cpu_s` limits the processor time, and with it the memory; None
        sets no limit. `environment` is added to the variables of this process; where it is not given, lines are wide.
        `place` is the folder of the standard streams and of temporary files, otherwise `cwd`. `more` is
        `kill_after_s` with `signum`.
        """
        assert self._process.stdin is not None
        variables = os.environ | ({"COLUMNS": "1000"} if environment is None else environment)
        streams = str(place or cwd)
        asked = {"words": words, "cwd": str(cwd), "cpu_s": cpu_s, "environment": variables, "place": streams, **more}
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return Ended(**self._said())

    def _said(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the warm process ended"
        return json.loads(line)


@cache
def warm() -> Warm:
    """The warm process that all tests of this worker share; it ends with the worker."""
    folder = tempfile.TemporaryDirectory(prefix="cosim-warm-")
    process = Warm(Path(folder.name)).__enter__()
    atexit.register(folder.cleanup)
    atexit.register(process.__exit__)
    return process


def _serve(folder: Path) -> None:
    from cosim.__main__ import main
    from cosim.traffic import sumo, sumo_process  # noqa: F401  the second loads SUMO
    from cosim.traffic.scenario import find
    from cosim.traffic.scene_summary import scene_summary
    from tests import plain_world
    from tests.hostile.scenes import write_trace

    plain_world.enter()
    sumo.started = _forked_sumo
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.argv = ["cosim", "run", *sets_of_trace(write_trace(folder)), "--out", str(folder / "warm")]
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, "the first run failed"
    scene_summary(find("helsinki"))  # most runs are in this city: its files are read once
    with answers:
        gc.collect()
        gc.freeze()  # so that children need not copy what they only read
        answers.write('"ready"\n')
        answers.flush()
        for line in sys.stdin:
            answers.write(json.dumps(asdict(_carried_out(main, **json.loads(line)))) + "\n")
            answers.flush()


def _forked_sumo(log: Path) -> subprocess.Popen[bytes]:
    """SUMO's process as a fork of this one, which has loaded its library."""
    from cosim.traffic import sumo_process

    def serve() -> None:
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))  # of `Popen`, which waits until its child has closed it
        try:
            sumo_process.main()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)

    pipe = subprocess.PIPE
    with log.open("ab") as errors:
        return subprocess.Popen(["sumo"], stdin=pipe, stdout=pipe, stderr=errors, preexec_fn=serve)


def set_words(keys: Iterable[str]) -> list[str]:
    """Words of a command line that set keys: `key=value` each."""
    return [word for key in keys for word in ("--set", key)]


def manifest_of(folder: Path) -> dict[str, Any]:
    """The manifest of a run as it is written."""
    return json.loads((folder / "manifest.json").read_text(encoding="utf-8"))


def sets_of_trace(path: Path) -> list[str]:
    """Words of a short run of a trace with everything on."""
    keys = (
        "preset=v0.2", f"traffic.scenario={path}", "fleet.penetration_p=1", "record.level=full", "record.block_steps=3",
        "attacks.0.start_s=0", "attacks.0.share_p=0.3", "attacks.1.start_s=0", "attacks.1.share_p=0.2",
        "lidar.n_azimuths=300", "trust.server_period_s=2", "traffic.duration_s=6",
    )  # fmt: skip
    return set_words(keys)


def _carried_out(
    main: Any, words: list[str], cwd: str, cpu_s: float | None, environment: dict[str, str], place: str,
    kill_after_s: float | None = None, signum: int = signal.SIGKILL,
) -> Ended:  # fmt: skip
    place = Path(place)
    scratch, out, err = place / ".tmp", place / ".out", place / ".err"
    scratch.mkdir(exist_ok=True)
    pid = os.fork()
    if not pid:
        os._exit(_child(main, words, Path(cwd), cpu_s, environment, place))
    begin, killed = time.monotonic(), False
    while True:
        ended, status, usage = os.wait4(pid, os.WNOHANG)
        if ended:
            break
        waited_s = time.monotonic() - begin
        if kill_after_s is not None and waited_s > kill_after_s and not killed:
            os.kill(pid, signum)
            killed = True
        if waited_s > (20 * cpu_s if cpu_s else 600):  # it sleeps
            os.kill(pid, XCPU)
        time.sleep(0.002)
    left = sorted(path.name for path in scratch.iterdir())
    for path in left:
        subprocess.run(["rm", "-rf", str(scratch / path)], check=False)
    said, complained = (path.read_text(errors="replace") if path.exists() else "" for path in (out, err))
    return Ended(os.waitstatus_to_exitcode(status), said, complained, usage.ru_utime + usage.ru_stime, left)


def _child(
    main: Any, words: list[str], cwd: Path, cpu_s: float | None, environment: dict[str, str], place: Path
) -> int:  # fmt: skip
    """What a process of its own would do, from its arguments to its exit status."""
    from cosim.cli import console

    os.chdir(cwd)
    sys.path.insert(0, str(cwd))
    os.environ.clear()
    os.environ |= environment
    tempfile.tempdir = str(place / ".tmp")
    if "COLUMNS" in environment:  # a console keeps the width that it found when the program was imported
        console.screen.width = console.notes.width = int(environment["COLUMNS"])
    for number, name in ((0, os.devnull), (1, ".out"), (2, ".err")):
        os.dup2(os.open(place / name, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666), number)
    if cpu_s:
        _limit(cpu_s)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if (threads := sys.modules.get("numba.np.ufunc.parallel")) is not None:
        threads._set_init_process_lock()  # an earlier child that was killed may hold the one of all children
    sys.argv = ["cosim", *words]
    try:
        if words[0] == "python":
            sys.argv = ["-c", *words[2:]]
            exec(compile(words[1], "<string>", "exec"), {"__name__": "__main__"})
        else:
            main(*([_simulate] if words[0] == "simulate" else []))
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            status = status or 120
    return status


def _limit(cpu_s: float) -> None:
    """So much processor time, and so much memory."""
    used_s = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
    resource.setrlimit(resource.RLIMIT_CPU, (int(used_s + cpu_s + 1), int(used_s + cpu_s + 5)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _simulate(standalone_mode: bool) -> None:
    """`cosim run [CONFIG] --set ... --out FOLDER`, as far as the folder is written."""
    from cosim.cli.console import progress
    from cosim.config.config import load
    from cosim.runs import run as running

    *words, flag, out = sys.argv[2:]
    config, sets = (words[0], words[1:]) if len(words) % 2 else (None, words)
    assert flag == "--out" and set(sets[::2]) <= {"--set"} and not standalone_mode
    with progress() as advance:
        running.run(load(config and Path(config), sets[1::2]), Path(out), advance)


if __name__ == "__main__":
    _serve(Path(sys.argv[1]))
