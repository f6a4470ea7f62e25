"""Cells on the workers of a Dask scheduler compute what one process computes, whatever dies meanwhile."""

import hmac
import os
import pickle
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
import psutil
import pytest

from cosim.addons.cells.channel import NetworkChannel
from cosim.addons.cells.crew import Crew
from cosim.addons.cells.perception import CellPerception
from cosim.addons.cells.placed import placed
from cosim.addons.cells.start import Cells
from cosim.addons.paper.scenarios import ScriptedScene
from cosim.runs import process
from cosim.step.parts import perception_of
from results.archive import read_manifest
from results.recorder import fingerprint
from tests.addons.cells.test_cells import kill, sensed
from tests.cosim.studies.runs import loopback, wait_for
from tests.drive import cosim, simulate
from tests.scene import assert_same, parts_of

SHORT = ("preset=v0.2", "traffic.duration_s=240", "traffic.warmup_s=60", "record.block_steps=10", "seed=37")


def words(*settings):
    return [word for key in settings for word in ("--set", key)]


@pytest.fixture
def network():
    """Two ends of a connection of TCP."""
    with socket.create_server(("127.0.0.1", 0)) as door:
        here = socket.create_connection(door.getsockname())
        there, _ = door.accept()
    ends = NetworkChannel(here), NetworkChannel(there)
    yield ends
    for end in ends:
        end.close()


def test_a_connection_carries_arrays_of_every_kind(network):
    here, there = network
    for size in (0, 7, 3_000_000):
        sent = {"a": np.arange(size), "b": np.asfortranarray(np.ones((size, 3), np.float32)), "c": None, "d": "text"}
        sender = threading.Thread(target=here.send, args=(sent,))
        sender.start()
        got = there.receive()
        sender.join()
        assert_same(got, sent)
        assert got["a"].flags.writeable and got["b"].flags.f_contiguous
    assert here.n_bytes == there.n_bytes > 3_000_000 * 20


def test_who_ends_is_heard(network):
    here, there = network
    here.close()
    with pytest.raises(EOFError):
        there.receive()
    with pytest.raises(ConnectionError):
        for _ in range(3):  # the first may still find room in a buffer
            there.send(np.zeros(1_000_000))


@pytest.mark.parametrize("known", [True, False])
def test_worker_and_run_show_each_other_that_they_know_a_secret(network, known):
    """The worker answers a challenge and sends its own. Who does not know the secret cannot answer that."""
    worker, run = network
    secret, challenge, heard = bytes(range(32)), bytes(32), []

    def as_run():
        run._socket.sendall(challenge)
        said = bytes(run._into(memoryview(bytearray(64))))
        heard.append(said[:32] == hmac.digest(secret, b"worker" + challenge, "sha256"))
        run._socket.sendall(hmac.digest(secret if known else bytes(32), b"run" + said[32:], "sha256"))

    other = threading.Thread(target=as_run)
    other.start()
    assert worker.knows(secret) == known
    other.join()
    assert heard == [True]


def test_a_worker_reads_no_message_of_a_stranger(tmp_path):
    """Messages are pickles: a stranger at the run's port would run code."""
    with socket.create_server(("127.0.0.1", 0)) as door:
        host, port = door.getsockname()
        worker = subprocess.Popen(
            process.command("cosim.addons.cells", "connect", host, str(port)), stdin=subprocess.PIPE,
            stderr=subprocess.PIPE, env=process.environment(),
        )  # fmt: skip
        worker.stdin.write(bytes(range(32)))
        worker.stdin.flush()
        stranger, _ = door.accept()
        sent = pickle.dumps((pickle.dumps(Trap(str(tmp_path / "sentinel")), 5), []))
        stranger.sendall(bytes(32) + bytes(32) + len(sent).to_bytes(8, "little") + sent)
        assert b"is not the run that asked for this worker" in worker.stderr.read()
        assert worker.wait() == 1 and not (tmp_path / "sentinel").exists()
        worker.stdin.close()
        worker.stderr.close()
        stranger.close()


class Trap:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def test_what_no_scheduler_is_for():
    with pytest.raises(ValueError, match=r"--scheduler tcp://h:1 is for cells: give --cells N, or --cells auto.$"):
        Cells.of("0", "tcp://h:1")


def test_a_scene_on_workers_of_a_scheduler_is_the_scene(tmp_path):
    """A worker dies in the second step, and a stranger connects meanwhile."""
    parts = parts_of(ScriptedScene.load(), "trust.host=local")
    parts = replace(parts, perception=perception_of(parts.config, parts.city))
    with loopback(tmp_path, 3) as (address, _):
        with pytest.raises(ValueError, match=r"the workers of .* have 3 threads, and each cell takes one. Start more"):
            wait_for(lambda: n_threads(address) == 3)
            with placed(address, 4):
                pass
        with placed(address, None) as workers, Crew(2, parts.perception, (), workers) as crew:
            assert workers.room == 3

            def deaths(number):
                if number == 1:
                    kill(crew.pids[1])
                    with socket.create_connection(workers._address) as stranger:
                        stranger.sendall(bytes(32))

            cells = CellPerception(parts.perception, crew, parts.config.lidar.max_range_m)
            found, _ = sensed(replace(parts, perception=cells, compare=cells.compare), deaths, ahead=True)
            pids = crew.pids
        want, _ = sensed(parts)
        assert_same(found, want)
        assert crew.n_replaced == 1
        wait_for(lambda: not any(map(psutil.pid_exists, pids)))


def n_threads(address):
    with suppress(ValueError), placed(address, None) as workers:
        return workers.room


class Run:
    """`cosim run` in cells of a scheduler."""

    def __init__(self, out, address, n_cells, *settings):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "cosim", "run", *words(*settings), "--cells", str(n_cells), "--scheduler", address,
             "--out", str(out)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def ended(self):
        _, said = self.process.communicate(timeout=300)
        return self.process.returncode, said


def cells_of(worker):
    """Processes of cells below a Dask worker."""
    with suppress(psutil.Error):
        below = psutil.Process(worker.pid).children(recursive=True)
        return [p.pid for p in below if "cosim.addons.cells" in p.cmdline()]
    return []


@pytest.mark.verify
def test_kills_of_cells_and_of_dask_workers_change_no_table(tmp_path):
    rng = random.Random(3)
    with loopback(tmp_path, 4) as (address, workers):
        wait_for(lambda: n_threads(address) == 4)
        run = Run(tmp_path / "cells", address, 2, *SHORT)
        wait_for(lambda: (tmp_path / "cells").is_dir() or run.process.poll() is not None)
        for kills in range(4):
            time.sleep(rng.uniform(0.5, 1.5))
            busy = [worker for worker in workers if worker.poll() is None and cells_of(worker)]
            if kills % 2:
                os.killpg(rng.choice(busy).pid, signal.SIGKILL)
            else:
                os.kill(rng.choice(cells_of(rng.choice(busy))), signal.SIGKILL)
        assert run.ended()[0] == 0
    assert read_manifest(tmp_path / "cells")["cells"]["replaced"] >= 2
    assert fingerprint(tmp_path / "cells") == fingerprint(simulate(tmp_path / "one", *SHORT))


@pytest.mark.verify
def test_a_cell_that_dies_without_a_scheduler_ends_the_run_in_one_line_and_resume_continues(tmp_path):
    """While the cells live, the run does without the scheduler."""
    out = tmp_path / "cells"
    with loopback(tmp_path, 2) as (address, workers):
        wait_for(lambda: n_threads(address) == 2)
        run = Run(out, address, 2, *SHORT)
        wait_for(lambda: list(out.glob("checkpoint/*")) or run.process.poll() is not None)
        (scheduler,) = (p for p in psutil.process_iter() if address.rpartition(":")[2] in ports_of(p))
        scheduler.kill()
        time.sleep(2)
        os.kill(next(pid for worker in workers for pid in cells_of(worker)), signal.SIGKILL)
        status, said = run.ended()
        assert status == 1 and said.count("\n") == 1, said
        assert "the scheduler is lost" in said and f"cosim resume {out}" in said
        wait_for(lambda: not any(map(cells_of, workers)))
    assert cosim("resume", str(out)).returncode == 0
    assert fingerprint(out) == fingerprint(simulate(tmp_path / "one", *SHORT))


def ports_of(process):
    """Ports at which a scheduler of Dask listens, as text."""
    with suppress(psutil.Error):
        if any("dask_scheduler" in word for word in process.cmdline()):
            return {str(c.laddr.port) for c in process.net_connections() if c.status == "LISTEN"}
    return set()


MINE = """
from cosim.extend import Reports


class Mine:
    def detect(self, sweeps, seen, boxes, label, draws):
        found = (seen.n_returns >= 20).nonzero()[0]
        actor = seen.actor[found]
        return Reports.of_actors(seen, found, label[actor], boxes.take(actor), 0.5 + 0.0 * actor)
"""


@pytest.mark.verify
def test_a_detector_of_the_users_own(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    mine = (*SHORT, "traffic.duration_s=10", f"detector.model={tmp_path / 'mine.py'}:Mine")
    with loopback(tmp_path, 2) as (address, _):
        wait_for(lambda: n_threads(address) == 2)
        assert Run(tmp_path / "cells", address, 2, *mine).ended()[0] == 0
    assert fingerprint(tmp_path / "cells") == fingerprint(simulate(tmp_path / "one", *mine))
