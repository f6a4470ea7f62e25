"""Workers on the machines of a Dask scheduler.

Dask chooses the machine of each worker and starts it there, in a process of its own. The worker then connects to the
run, and what flows in every step does not pass through the scheduler. Worker and run prove to each other that they know
a secret, which the worker gets through Dask and which does not cross the connection. Neither reads anything else from
who does not know it. As with Dask itself, who can read the network sees all, and who can reach the scheduler can run
code.
"""

import secrets
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from distributed import Client, Future
from distributed.comm import get_address_host_port
from distributed.utils import get_ip

from cosim.addons.cells.channel import SECRET_BYTES, Channel, NetworkChannel, proof
from cosim.addons.cells.crew import CellLost
from cosim.addons.cells.nursery import MOST, ONE_THREAD
from cosim.runs import process
from cosim.runs.cluster import closing_quietly, connected

_PATIENCE_S = 120.0
"""Longest wait for a worker to connect. It imports the program first."""
_HELLO_S = 5.0
"""Longest wait for the proof of who has connected."""
_LOOK_S = 0.5


@contextmanager
def placed(scheduler: str, n_cells: int | None) -> Iterator["Placed"]:
    """Workers on the machines of a scheduler, which begin to start; None for one per thread of its Dask workers.

    Raises
    ------
    ValueError
        In one line, if the scheduler and its workers cannot do it.
    """
    with closing_quietly(), connected(scheduler) as client:
        n_threads = sum(client.nthreads().values())
        if n_cells is not None and n_cells > n_threads:
            raise ValueError(
                f"--cells {n_cells}: the workers of {scheduler} have {n_threads} threads, and each cell takes one. "
                f"Start more workers, or give {n_threads} cells or fewer."
            )
        workers = Placed(client, scheduler, min(n_threads, MOST) if n_cells is None else n_cells)
        try:
            yield workers
        finally:
            workers.close()


class Placed:
    """Workers on other machines, as `Workers`.

    Parameters
    ----------
    client
        Of the scheduler.
    scheduler
        Its address, for messages.
    n_workers
        So many begin to start at once, before they are asked for.
    """

    def __init__(self, client: Client, scheduler: str, n_workers: int) -> None:
        self._client, self._scheduler = client, scheduler
        self.room = n_workers
        host = get_ip(*get_address_host_port(client.scheduler_info()["address"]))
        self._door = socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        self._door.settimeout(_LOOK_S)
        self._address = host, int(self._door.getsockname()[1])
        self._awaited: dict[bytes, Future] = {}
        for _ in range(n_workers):
            self._place()

    def _place(self) -> None:
        secret = secrets.token_bytes(SECRET_BYTES)
        name = f"cosim-cell-{secrets.token_hex(8)}"
        self._awaited[secret] = self._client.submit(hold, *self._address, secret, key=name, pure=False)

    def new(self, own: Sequence[str], perception: Any) -> Channel:
        """As in `Workers`."""
        if not self._awaited and self._client.status != "closed":
            self._place()
        channel = self._connected()
        try:
            channel.send(list(own))
            said = channel.receive()
            if isinstance(said, Exception):
                reason = " ".join(str(said).split())
                raise CellLost(f"--scheduler {self._scheduler}: a worker cannot load {', '.join(own)}: {reason}")
            channel.send(perception)
        except BaseException:
            channel.close()
            raise
        return channel

    def _connected(self) -> "_Channel":
        """The channel of the next worker that connects."""
        end_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < end_s and self._client.status != "closed":
            with suppress(TimeoutError):
                connection, _ = self._door.accept()
                if (future := self._greeted(connection)) is not None:
                    return _Channel(connection, future)
                connection.close()
            for secret, future in list(self._awaited.items()):
                if future.done():
                    del self._awaited[secret]
                    raise EOFError  # it has ended before it has connected
        if self._client.status == "running":
            raise CellLost(f"--scheduler {self._scheduler}: no worker has a free thread for a cell. Start more workers")
        raise CellLost(f"--scheduler {self._scheduler}: the scheduler is lost")

    def _greeted(self, connection: socket.socket) -> Future | None:
        """The task of who has connected; None for a stranger."""
        connection.settimeout(_HELLO_S)
        challenge, said = secrets.token_bytes(SECRET_BYTES), b""
        with suppress(OSError):
            connection.sendall(challenge)
            while len(said) < 2 * SECRET_BYTES and (more := connection.recv(2 * SECRET_BYTES - len(said))):
                said += more
            answer, of_worker = said[:SECRET_BYTES], said[SECRET_BYTES:]
            for secret in list(self._awaited):
                if secrets.compare_digest(answer, proof(secret, "worker", challenge)):
                    connection.sendall(proof(secret, "run", of_worker))
                    return self._awaited.pop(secret)
        return None

    def close(self) -> None:
        """As in `Workers`."""
        self._door.close()
        for future in self._awaited.values():
            _cancel(future)
        self._awaited = {}


class _Channel(NetworkChannel):
    """The channel of a worker, and the task that holds it."""

    def __init__(self, connection: socket.socket, future: Future) -> None:
        super().__init__(connection)
        self._future = future

    def close(self) -> None:
        """As in `Channel`. Dask does not start the worker again."""
        super().close()
        _cancel(self._future)


def _cancel(future: Future) -> None:
    with suppress(Exception):  # the scheduler is lost, and with it the task
        future.cancel()


def hold(host: str, port: int, secret: bytes) -> int:
    """Be a thread of a Dask worker that holds the process of a cell; return its exit status.

    The process ends with its connection to the run, or with the Dask worker, which closes its standard input.
    """
    worker = subprocess.Popen(
        process.command("cosim.addons.cells", "connect", host, str(port)),
        stdin=subprocess.PIPE, env=process.environment(**ONE_THREAD),
    )  # fmt: skip
    assert worker.stdin is not None
    try:
        with suppress(OSError):
            worker.stdin.write(secret)
            worker.stdin.flush()
        return worker.wait()
    finally:
        worker.kill()
        worker.wait()
