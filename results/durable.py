"""Files that are there whole or not at all, whatever is cut off: written beside, synced, renamed."""

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
    """A run folder does not hold what its inventory says; commands end with exit status 1."""


class Growing(io.RawIOBase):
    """A file that is written piece by piece and has its name once it is whole, on disk; its length and checksum."""

    def __init__(self, partial: Path) -> None:
        """`partial` is its name until then; a file of that name is replaced."""
        self._partial = partial
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW
        self._file, self._sha256 = io.BufferedWriter(io.FileIO(os.open(partial, flags, 0o666), "w")), hashlib.sha256()
        self.n_bytes = 0

    def writable(self) -> bool:
        """Always."""
        return True

    def tell(self) -> int:
        """Bytes written so far."""
        return self.n_bytes

    def write(self, content: bytes | memoryview) -> int:  # type: ignore[override]
        """Add all of it."""
        n = self._file.write(content)
        self._sha256.update(content)
        self.n_bytes += n
        return n

    def finish(self, path: Path) -> str:
        """Sync it and give it its name; its checksum."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._partial.replace(path)
        return self._sha256.hexdigest()

    def close(self) -> None:
        """Give the handle back; what was not finished stays under its partial name."""
        self._file.close()
        super().close()


def write(path: Path, *pieces: bytes | memoryview) -> str:
    """Write a file whole, so that neither a kill nor a power cut leaves a part of it; replaces one that is there.

    Returns its checksum.
    """
    file = Growing(path.with_name(path.name + PARTIAL))
    try:
        for piece in pieces:
            file.write(piece)
        return file.finish(path)
    finally:
        file.close()


def write_output(path: Path, content: bytes) -> None:
    """Write a file under a name that the user gave, whole or not at all; a symbolic link is replaced, not followed.

    Folders that are missing are made. ValueError where it is a folder; OSError that names the file where it cannot be
    written. Devices and pipes are written to.
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
    """Add a line at the end of a file, on disk when this returns."""
    with open(os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o666), "ab") as file:
        file.write(line + b"\n")
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Put the names in a folder on disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def open_regular(path: Path) -> BufferedReader:
    """A file for reading; ValueError where it is no regular file (a device or a pipe may never end)."""
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
    """Plain data with a checksum of itself as its last key."""
    content = {key: value for key, value in content.items() if key != _SEAL}
    return content | {_SEAL: _digest(content)}


def is_sealed(content: dict[str, Any]) -> bool:
    """Whether the checksum that plain data carry is their own."""
    return content.get(_SEAL) == _digest({key: value for key, value in content.items() if key != _SEAL})


def _digest(content: dict[str, Any]) -> str:
    """Independent of spaces and of the order of keys; a number counts as it is written."""
    text = json.dumps(content, sort_keys=True, ensure_ascii=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


class Lock:
    """Says that a process writes into a folder; the system takes it back when the process ends, however it ends."""

    def __init__(self, folder: Path) -> None:
        """Take it; BlockingIOError where another process holds it."""
        self._path = folder / _LOCK
        while True:
            self._handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
            try:
                fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if self._path.exists() and self._path.stat().st_ino == os.fstat(self._handle).st_ino:
                    return
            except OSError:
                os.close(self._handle)
                raise
            os.close(self._handle)  # its last owner has removed the file since it was opened

    def is_held(self) -> bool:
        """Whether the folder still is the one that was locked, and not a later one of the same name."""
        try:
            return self._handle >= 0 and self._path.stat().st_ino == os.fstat(self._handle).st_ino
        except OSError:
            return False

    def release(self) -> None:
        """Give it back and remove its file; once more does nothing."""
        if self._handle < 0:
            return
        handle, self._handle = self._handle, -1
        try:
            if self._path.exists() and self._path.stat().st_ino == os.fstat(handle).st_ino:
                self._path.unlink(missing_ok=True)
        finally:
            os.close(handle)


def is_locked(folder: Path) -> bool:
    """Whether a process writes into a folder now."""
    try:
        handle = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
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
