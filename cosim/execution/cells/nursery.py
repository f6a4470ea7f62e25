"""The process that forks the workers of cells."""

import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from cosim.execution.cells.channel import Channel

_ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""Of a worker; the processes are the threads."""


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
        self.knows_perception = False
        """Whether `teach` has succeeded."""
        self._channel, files = Channel.pair()
        self._control = socket.socket(fileno=os.dup(self._channel.fileno()))
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "cosim.execution.cells", *map(str, files)], pass_fds=files,
                stdin=subprocess.DEVNULL, env=os.environ | _ONE_THREAD,
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
        self.knows_perception = True

    def fork(self, files: list[int]) -> None:
        """Fork a worker with these files as its end of a channel; raises OSError if the process has ended."""
        socket.send_fds(self._control, [b"w"], files)

    def close(self) -> None:
        """End the process. Workers that it has forked go on."""
        self._control.close()
        self._channel.close()
        self._process.kill()  # it holds nothing that must be kept, and would take half a second to free its memory
        self._process.wait()
