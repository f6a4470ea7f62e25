"""Messages between two processes.

Between those of one machine, arrays go through shared memory and all else through a socket. The memory belongs to no
name in the file system. The kernel frees it when the last process that holds it has ended, in whatever way it ended.
Between two machines, all goes through a socket.
"""

import hmac
import mmap
import os
import pickle
import secrets
import socket
import tempfile
from multiprocessing.connection import Connection
from typing import Any, Protocol

import numpy as np

_ALIGNED = 64
"""Arrays begin at multiples of this number of bytes, as NumPy's own arrays do."""


SECRET_BYTES = 32
"""Of a secret, of a challenge, and of a proof."""


class Channel(Protocol):
    """One end of a channel. One message is under way in each direction at most."""

    n_bytes: int
    """Bytes sent and received so far."""

    def send(self, what: Any) -> None:
        """Send an object. It may change afterwards.

        Raises
        ------
        OSError
            If the process at the other end has ended (ConnectionError), or if there is no memory for the message.
        """

    def receive(self) -> Any:
        """Wait for the next object. The next message may overwrite its arrays.

        Raises
        ------
        EOFError, OSError
            If the process at the other end has ended.
        """

    def close(self) -> None:
        """Close this end. The process at the other end notices it when it next waits for a message."""


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


class SharedChannel:
    """As `Channel`, between two processes of one machine."""

    def __init__(self, fds: list[int]) -> None:
        """From the socket of this end, the memory of what it sends, and the memory of what it receives."""
        self._socket, self._out, self._in = Connection(fds[0]), _Memory(fds[1]), _Memory(fds[2])
        self.n_bytes = 0

    @staticmethod
    def pair() -> tuple["SharedChannel", list[int]]:
        """One end, and the files from which another process makes the other end. The caller closes the files."""
        here, there = socket.socketpair()
        out, back = _unnamed(), _unnamed()
        return SharedChannel([here.detach(), out, back]), [there.detach(), os.dup(back), os.dup(out)]

    def send(self, what: Any) -> None:
        """As in `Channel`."""
        content, arrays = _pickled(what)
        places, end = _places([array.raw().nbytes for array in arrays])
        memory = self._out.of_size(end)
        for (begin, size), array in zip(places, arrays, strict=True):
            memory[begin : begin + size] = array.raw()
        self.n_bytes += end + len(content)
        self._socket.send_bytes(pickle.dumps((content, places)))

    def receive(self) -> Any:
        """As in `Channel`. The arrays are in shared memory, which the next message overwrites."""
        content, places = pickle.loads(self._socket.recv_bytes())
        end = max((begin + size for begin, size in places), default=0)
        memory = self._in.of_size(end)
        self.n_bytes += end + len(content)
        return pickle.loads(content, buffers=[memory[begin : begin + size] for begin, size in places])

    def fileno(self) -> int:
        """The socket of this end."""
        return self._socket.fileno()

    def close(self) -> None:
        """As in `Channel`."""
        if not self._socket.closed:
            self._socket.close()
            for memory in (self._out, self._in):
                os.close(memory.fd)


class NetworkChannel:
    """As `Channel`, between two machines, over a connection of TCP.

    A connection over which nothing comes for about a minute, not even the system's own probes, has ended.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._socket, self._memory = connection, memoryview(bytearray())
        self.n_bytes = 0
        connection.settimeout(None)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in (("TCP_KEEPIDLE", 30), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 3)):
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def send(self, what: Any) -> None:
        """As in `Channel`."""
        content, arrays = _pickled(what)
        head = pickle.dumps((content, [array.raw().nbytes for array in arrays]))
        try:
            self._socket.sendall(len(head).to_bytes(8, "little") + head)
            for array in arrays:
                self._socket.sendall(array.raw())
        except OSError as error:
            raise ConnectionError(str(error)) from None
        self.n_bytes += 8 + len(head) + sum(array.raw().nbytes for array in arrays)

    def receive(self) -> Any:
        """As in `Channel`."""
        n_head = int.from_bytes(self._into(memoryview(bytearray(8))), "little")
        content, sizes = pickle.loads(self._into(memoryview(bytearray(n_head))))
        places, end = _places(sizes)
        if len(self._memory) < end:
            self._memory = np.empty(end + end // 4, np.uint8).data  # used again: new memory takes longer than the copy
        arrays = [self._into(self._memory[begin : begin + size]) for begin, size in places]
        self.n_bytes += 8 + n_head + sum(sizes)
        return pickle.loads(content, buffers=arrays)

    def knows(self, secret: bytes) -> bool:
        """Answer the challenge of who is at the other end, and return whether it knows the secret too.

        Messages are pickles, which can run code, so none is read from anybody else.
        """
        challenge = bytes(self._into(memoryview(bytearray(SECRET_BYTES))))
        mine = secrets.token_bytes(SECRET_BYTES)
        self._socket.sendall(proof(secret, "worker", challenge) + mine)
        said = bytes(self._into(memoryview(bytearray(SECRET_BYTES))))
        return hmac.compare_digest(said, proof(secret, "run", mine))

    def keep_last(self) -> None:
        """Let the next messages not overwrite the arrays of the last one."""
        self._memory = memoryview(bytearray())

    def _into(self, place: memoryview) -> memoryview:
        n = 0
        while n < len(place):
            if not (more := self._socket.recv_into(place[n:])):
                raise EOFError
            n += more
        return place

    def close(self) -> None:
        """As in `Channel`."""
        self._socket.close()


def proof(secret: bytes, of: str, challenge: bytes) -> bytes:
    """Shows who has sent a challenge that the run or a worker (`of`) knows the secret, without telling it."""
    return hmac.digest(secret, of.encode() + challenge, "sha256")


def _pickled(what: Any) -> tuple[bytes, list[pickle.PickleBuffer]]:
    """An object without its arrays, and these."""
    arrays: list[pickle.PickleBuffer] = []
    return pickle.dumps(what, 5, buffer_callback=arrays.append), arrays


def _places(sizes: list[int]) -> tuple[list[tuple[int, int]], int]:
    """Where arrays of these sizes lie one after the other, as begin and size, and the end of all."""
    places, end = [], 0
    for size in sizes:
        places.append((end, size))
        end = -(-(end + size) // _ALIGNED) * _ALIGNED
    return places, end


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
