"""Temporary folders. If a process is killed, the next process that starts removes its folder."""

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

_PREFIX = "cosim."


class Scratch:
    """A temporary folder. It is locked as long as this process runs."""

    def __init__(self) -> None:
        remove_orphans()
        self.path = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}."))
        self._handle = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        with suppress(OSError):  # without locks, only the process id tells whether the folder is in use
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)

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
        pid = path.name.split(".")[1]
        with suppress(OSError):
            if not pid.isdecimal() or path.is_symlink() or path.stat().st_uid != os.getuid() or _lives(int(pid)):
                continue
            handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(handle)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
