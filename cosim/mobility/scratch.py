"""Temporary folders that die with their process, also when it is killed: the next one that starts removes them."""

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

_PREFIX = "cosim."


class Scratch:
    """A temporary folder; locked for as long as this process lives."""

    def __init__(self) -> None:
        remove_orphans()
        self.path = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}."))
        self._handle = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        with suppress(OSError):  # without locks the process id alone says whether it is in use
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def remove(self) -> None:
        """Remove it and all in it; once more does nothing."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1
            shutil.rmtree(self.path, ignore_errors=True)


def can_hold_files(folder: Path) -> bool:
    """Whether files can be written into a folder, which is made if it is not there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def remove_orphans() -> None:
    """Remove this user's folders whose process is gone."""
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
