"""Write files completely or not at all, even in a crash: write under another name, sync, rename."""

import errno
import fcntl
import hashlib
import io
import json
import os
import stat
from contextlib import suppress
from io import BufferedReader
from pathlib import Path
from typing import Any

PARTIAL = ".partial"
"""Suffix of a file that is being written."""
_LOCK = ".lock"
_SEAL = "sha256"


class Damaged(ValueError):
    """A run folder differs from its inventory. Commands end with exit status 1."""


def new_file(path: Path) -> int:
    """Create an empty file, open for writing; return its descriptor.

    What has its name is removed and not opened: a link of somebody else could lead anywhere, and a pipe would wait for
    a reader.
    """
    path.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
    return os.open(path, flags, 0o666)


class Growing(io.RawIOBase):
    """A file that is written piece by piece and gets its name when it is complete; counts bytes and checksum."""

    def __init__(self, partial: Path) -> None:
        """`partial` is the name until then. An existing file of that name is replaced."""
        self._partial = partial
        self._file = io.BufferedWriter(io.FileIO(new_file(partial), "w"))
        self._sha256 = hashlib.sha256()
        self.n_bytes = 0

    def writable(self) -> bool:
        """Always."""
        return True

    def tell(self) -> int:
        """Bytes written so far."""
        return self.n_bytes

    def write(self, content: bytes | memoryview) -> int:  # type: ignore[override]
        """Append the content."""
        n = self._file.write(content)
        self._sha256.update(content)
        self.n_bytes += n
        return n

    def finish(self, path: Path) -> str:
        """Sync the file, give it its name and return its checksum."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._partial.replace(path)
        return self._sha256.hexdigest()

    def close(self) -> None:
        """Close the file. An unfinished file keeps its partial name."""
        self._file.close()
        super().close()


def write(path: Path, *pieces: bytes | memoryview) -> str:
    """Write a complete file, of which neither a kill nor a power cut leaves only a part. An existing file is replaced.

    Returns
    -------
    The checksum of the file.
    """
    file = Growing(path.with_name(path.name + PARTIAL))
    try:
        for piece in pieces:
            file.write(piece)
        return file.finish(path)
    finally:
        file.close()


def write_output(path: Path, content: bytes) -> None:
    """Write a file under a name that the user gave, completely or not at all.

    A symbolic link is replaced, not followed. Missing folders are created. Devices and pipes are written to.

    Raises
    ------
    ValueError
        If the path is a folder.
    OSError
        If the file cannot be written; it names the file.
    """
    if path.is_dir():
        raise ValueError(f"{path} is a folder. Give the name of a file.")
    if path.exists() and not path.is_symlink() and not path.is_file():
        path.write_bytes(content)
    else:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path, content)
        except OSError as error:
            with suppress(OSError):
                path.with_name(path.name + PARTIAL).unlink(missing_ok=True)
            raise OSError(error.errno, error.strerror, str(path)) from None


def append_line(path: Path, line: bytes) -> None:
    """Append a line to a file. It is on disk when the function returns."""
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW
    handle = os.open(path, flags, 0o666)
    with open(handle, "ab") as file:
        file.write(line + b"\n")
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that the names in it are on disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def open_lock(path: Path) -> int:
    """Open a file to lock it, which is made if there is none; return its descriptor.

    Raises
    ------
    OSError
        If it is a link or no regular file, or cannot be made.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    handle = os.open(path, flags, 0o666)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "no regular file", str(path))
    return handle


def read(path: Path) -> bytes:
    """Content of a regular file. Raises ValueError for others."""
    with open_regular(path) as file:
        return file.read()


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading. Raises ValueError for others: a device or a pipe may never end."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise ValueError(f"{path} is no regular file. Give the path of a file.")
    return open(handle, "rb")


def sha256(path: Path) -> str:
    """Checksum of a regular file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def seal(content: dict[str, Any]) -> dict[str, Any]:
    """Add a checksum of the data as the last key."""
    content = _unsealed(content)
    return content | {_SEAL: _digest(content)}


def is_sealed(content: dict[str, Any]) -> bool:
    """Whether the checksum in the data is correct."""
    return content.get(_SEAL) == _digest(_unsealed(content))


def _unsealed(content: dict[str, Any]) -> dict[str, Any]:
    """The data without their checksum."""
    return {key: value for key, value in content.items() if key != _SEAL}


def _digest(content: dict[str, Any]) -> str:
    """Checksum that does not depend on spaces and the order of keys; numbers count as they are written."""
    text = json.dumps(content, sort_keys=True, ensure_ascii=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


class Lock:
    """Lock of a process that writes into a folder. The operating system releases it when the process ends."""

    def __init__(self, folder: Path) -> None:
        """Take the lock. Raises BlockingIOError if another process has it."""
        self._path = folder / _LOCK
        while True:
            self._handle = open_lock(self._path)
            try:
                fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if _is_named(self._handle, self._path):
                    return
            except OSError:
                os.close(self._handle)
                raise
            os.close(self._handle)  # its last owner has removed the file since it was opened

    def is_held(self) -> bool:
        """Whether the folder is still the one that was locked, and not a later one of the same name."""
        try:
            return self._handle >= 0 and _is_named(self._handle, self._path)
        except OSError:
            return False

    def release(self) -> None:
        """Release the lock and remove its file. A second call does nothing."""
        if self._handle < 0:
            return
        handle, self._handle = self._handle, -1
        try:
            if _is_named(handle, self._path):
                self._path.unlink(missing_ok=True)
        finally:
            os.close(handle)


def _is_named(handle: int, path: Path) -> bool:
    """Whether an open file still has this name."""
    return path.exists() and path.stat().st_ino == os.fstat(handle).st_ino


def is_locked(folder: Path) -> bool:
    """Whether a process writes into a folder now."""
    try:
        handle = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(handle)
    return False


def is_lock(path: Path) -> bool:
    """Whether a path is that of a lock."""
    return path.name == _LOCK
