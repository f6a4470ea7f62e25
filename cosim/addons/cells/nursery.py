"""Workers on this machine, and the process that forks them."""

import os
import socket
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from cosim.addons.cells.channel import Channel, SharedChannel
from cosim.runs import process

MOST = 256
"""Workers of a run."""
ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""Environment of a worker; the processes are the threads."""


class Nursery:
    """A process that imports the program, gets the perception of a run, and then forks a worker whenever it is asked.

    The import takes two or three seconds, with that of compiled functions. Who starts the process early reads the city
    meanwhile.

    Raises
    ------
    OSError
        If there is no memory or no process for it.
    """

    def __init__(self) -> None:
        self.is_ready = False
        """Whether it knows the perception."""
        self._channel, files = SharedChannel.pair()
        self._control = socket.socket(fileno=os.dup(self._channel.fileno()))
        try:
            self._process = subprocess.Popen(
                process.command("cosim.addons.cells", *map(str, files)), pass_fds=files,
                stdin=subprocess.DEVNULL, env=process.environment(**ONE_THREAD),
            )  # fmt: skip
        except BaseException:
            self._control.close()
            self._channel.close()
            raise
        finally:
            for fd in files:
                os.close(fd)

    @property
    def pid(self) -> int:
        """The process."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def teach(self, own: Sequence[str], perception: Any) -> None:
        """Give it the perception of the run, and names of the user's own classes in it, as a config has them.

        Raises
        ------
        EOFError, OSError
            If the process has ended.
        """
        self._channel.send(list(own))
        self._channel.send(perception)
        self._channel.receive()
        self.is_ready = True

    def fork(self, files: list[int]) -> None:
        """Fork a worker with these files as its end of a channel; raises OSError if the process has ended."""
        socket.send_fds(self._control, [b"w"], files)

    def close(self) -> None:
        """End the process. Workers that it has forked go on."""
        self._control.close()
        self._channel.close()
        self._process.kill()  # it holds nothing that must be kept, and would take half a second to free its memory
        self._process.wait()


class Forked:
    """Workers on this machine. The process that forks them starts at once."""

    def __init__(self) -> None:
        self.room = min(max(1, n_cores() - 1), MOST)
        self.nursery: Nursery | None = None
        with suppress(OSError):  # `new` tries again
            self.nursery = Nursery()

    def new(self, own: Sequence[str], perception: Any) -> Channel:
        """As in `Workers`."""
        if self.nursery is None or not self.nursery.is_alive():
            self.close()
            self.nursery = Nursery()
        channel, files = SharedChannel.pair()
        try:
            if not self.nursery.is_ready:
                self.nursery.teach(own, perception)
            self.nursery.fork(files)
        except (EOFError, OSError):
            channel.close()
            self.close()
            raise
        finally:  # as long as this process holds the other end, it does not hear that the worker has ended
            for fd in files:
                os.close(fd)
        return channel

    def close(self) -> None:
        """As in `Workers`."""
        if self.nursery is not None:
            self.nursery.close()
        self.nursery = None


def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
