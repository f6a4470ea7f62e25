"""Messages between two processes of one machine: arrays through shared memory, all else through a socket.

The memory belongs to no name in the file system. The kernel frees it when the last process that holds it has ended, in
whatever way it ended.
"""

import mmap
import os
import pickle
import socket
import tempfile
from multiprocessing.connection import Connection
from typing import Any

_ALIGNED = 64
"""Arrays begin at multiples of this number of bytes, as NumPy's own arrays do."""


class _Memory:
    """Bytes of a file without a name, mapped into this process; they grow and never shrink."""

    def __init__(self, fd: int) -> None:
        self.fd, self._map = fd, mmap.mmap(-1, 1)

    def of_size(self, size: int) -> memoryview:
        """The first `size` bytes. Earlier views stay valid after the memory has grown."""
        if len(self._map) < size:
            if os.fstat(self.fd).st_size < size:
                _reserve(self.fd, size + size // 4)
            self._map = mmap.mmap(self.fd, os.fstat(self.fd).st_size)
        return memoryview(self._map)[:size]


class Channel:
    """One end of a channel. One message is under way in each direction at most."""

    def __init__(self, fds: list[int]) -> None:
        """From the socket of this end, the memory of what it sends, and the memory of what it receives."""
        self._socket, self._out, self._in = Connection(fds[0]), _Memory(fds[1]), _Memory(fds[2])
        self.n_bytes = 0
        """Bytes sent and received so far."""

    @staticmethod
    def pair() -> tuple["Channel", list[int]]:
        """One end, and the files from which another process makes the other end. The caller closes the files."""
        here, there = socket.socketpair()
        out, back = _unnamed(), _unnamed()
        return Channel([here.detach(), out, back]), [there.detach(), os.dup(back), os.dup(out)]

    def send(self, what: Any) -> None:
        """Send an object. It may change afterwards.

        Raises
        ------
        OSError
            If the process at the other end has ended.
        """
        arrays: list[pickle.PickleBuffer] = []
        content = pickle.dumps(what, 5, buffer_callback=arrays.append)
        places, end = [], 0
        for array in arrays:
            size = array.raw().nbytes
            places.append((end, size))
            end = -(-(end + size) // _ALIGNED) * _ALIGNED
        memory = self._out.of_size(end)
        for (begin, size), array in zip(places, arrays, strict=True):
            memory[begin : begin + size] = array.raw()
        self.n_bytes += end + len(content)
        self._socket.send_bytes(pickle.dumps((content, places)))

    def receive(self) -> Any:
        """Wait for the next object. Its arrays are in shared memory, which the next message overwrites.

        Raises
        ------
        EOFError, OSError
            If the process at the other end has ended.
        """
        content, places = pickle.loads(self._socket.recv_bytes())
        end = max((begin + size for begin, size in places), default=0)
        memory = self._in.of_size(end)
        self.n_bytes += end + len(content)
        return pickle.loads(content, buffers=[memory[begin : begin + size] for begin, size in places])

    def fileno(self) -> int:
        """The socket of this end."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close this end. The process at the other end notices it when it next waits for a message."""
        if not self._socket.closed:
            self._socket.close()
            for memory in (self._out, self._in):
                os.close(memory.fd)


def _reserve(fd: int, size: int) -> None:
    """Let a file have this size. If there is no room, this is an error now, and no fault when the bytes are written."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(fd, 0, size)
    else:
        os.ftruncate(fd, size)


def _unnamed() -> int:
    """A file in memory without a name, or on disk where the system has no such files."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("cosim cell")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
