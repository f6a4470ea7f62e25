"""Temporary folders. If a process is killed, the next process that starts removes its folder."""

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

_PREFIX = "cosim."
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
"""How a folder is opened, in order to lock it."""
_LOCK = fcntl.LOCK_EX | fcntl.LOCK_NB
"""A lock for one process alone. Where another process has it, flock raises an OSError at once."""


class Scratch:
    """A temporary folder. It is locked as long as this process runs."""

    def __init__(self) -> None:
        remove_orphans()
        self.path = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}."))
        self._handle = os.open(self.path, _FOLDER)
        with suppress(OSError):  # without locks, only the process id tells whether the folder is in use
            fcntl.flock(self._handle, _LOCK)

    def remove(self) -> None:
        """Remove the folder and its content. A second call does nothing."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1
            shutil.rmtree(self.path, ignore_errors=True)


def can_hold_files(folder: Path) -> bool:
    """Whether files can be written into a folder. The folder is created if it does not exist."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def remove_orphans() -> None:
    """Remove folders of this user whose process has ended."""
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*.*"):
        with suppress(OSError):  # a folder that has vanished meanwhile, or that is locked, is left alone
            if not _is_orphan(path):
                continue
            handle = os.open(path, _FOLDER)
            try:
                fcntl.flock(handle, _LOCK)
                shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(handle)


def _is_orphan(path: Path) -> bool:
    """Whether a folder is this user's, and the process whose id its name contains has ended."""
    pid = path.name.split(".")[1]
    if not pid.isdecimal() or path.is_symlink():
        return False
    return path.stat().st_uid == os.getuid() and not _is_running(int(pid))


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)  # signal 0 is not sent: it asks whether there is such a process
    except ProcessLookupError:
        return False
    except PermissionError:  # there is one, of another user
        return True
    return True
