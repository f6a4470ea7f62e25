"""The folder of a run. It belongs to one run and is locked while the run is written."""

import shlex
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from cosim.base.durable import PARTIAL, Lock, is_lock
from cosim.runs.stop import Failed
from results.manifest import MANIFEST


@dataclass(slots=True)
class RunFolder:
    """A run folder that is locked for this process."""

    path: Path
    lock: Lock
    made: tuple[Path, ...] = ()
    """Folders that were created for it, the outermost first."""

    def check(self) -> None:
        """Raise Failed if the folder was removed or now belongs to another run."""
        if not self.lock.is_held():
            raise Failed(f"{self.path} was removed while the run wrote into it. Nothing more is written.")

    def release(self) -> None:
        """Release the lock, so that other processes can write."""
        self.lock.release()

    def clear(self) -> None:
        """Delete everything except the lock. The manifest goes last, because a folder without it is not a run."""
        items = [item for item in self.path.iterdir() if not is_lock(item)]
        for item in sorted(items, key=lambda item: item.name == MANIFEST):
            shutil.rmtree(item) if item.is_dir() and not item.is_symlink() else item.unlink()

    def remove(self) -> None:
        """Remove the folder of a run that recorded nothing."""
        if self.path.is_dir() and self.lock.is_held():
            self.clear()
        self.release()
        for folder in reversed(self.made):
            with suppress(OSError):
                folder.rmdir()

    @contextmanager
    def or_nothing(self) -> Iterator[None]:
        """Remove the folder if the block fails. On a full disk, or where nobody may write, Failed says where."""
        try:
            yield
        except BaseException as error:
            with suppress(OSError):
                self.remove()
            if isinstance(error, OSError):
                where = error.filename or self.path
                raise Failed(f"{where}: {error.strerror or error}. Nothing was written.") from None
            raise


def check(out: Path | None) -> None:
    """Raise ValueError if `out` cannot become the folder of a new run."""
    if out is None:
        return
    try:
        if out.is_symlink() and not out.exists():
            raise ValueError(f"--out {out} is a link to nothing. Give a folder that is empty or does not exist.")
        if out.exists() and not out.is_dir():
            raise ValueError(f"--out {out} is a file. Give a folder that is empty or does not exist.")
        if out.is_dir() and (out / MANIFEST).exists():
            raise ValueError(
                f"--out {out} already holds a run. Give a folder that is empty or does not exist; a run that was cut "
                f"off goes on with: cosim resume {shlex.quote(str(out))}"
            )
        if out.is_dir() and any(not _is_leftover(item) for item in out.iterdir()):
            raise ValueError(f"--out {out} is not empty. Give a folder that is empty or does not exist.")
    except OSError as error:
        raise _cannot(out, error) from None


def create(out: Path | None, name: str) -> RunFolder:
    """Create and lock the folder `out`, or the next free folder `runs/<name>-N`; ValueError if that is impossible."""
    base = Path("runs") if out is None else out.absolute().parent
    try:
        made = _make(base)
        if out is None:
            n = 1
            while True:
                path = base / f"{name}-{n}"
                with suppress(FileExistsError):
                    path.mkdir()
                    return RunFolder(path, _lock(path), (*made, path))
                n += 1
        check(out)
        new = () if out.is_dir() else (out,)
        out.mkdir(exist_ok=True)
        lock = _lock(out)
        try:
            check(out)
        except ValueError:
            lock.release()
            raise
        return RunFolder(out, lock, (*made, *new))
    except OSError as error:
        raise _cannot(out or base, error) from None


def _is_leftover(item: Path) -> bool:
    """Whether a file was left by a run that was killed before it wrote its manifest. A new run overwrites it."""
    return is_lock(item) or item.name == MANIFEST + PARTIAL


def beside(out: Path) -> RunFolder:
    """A temporary folder that is renamed to `out` when it is complete. Files of a killed process in it are removed."""
    path = out.with_name(out.name + PARTIAL)
    try:
        made = _make(path)
    except OSError as error:
        raise _cannot(out, error) from None
    folder = reopen(path)
    folder.made = (*made, path) if path not in made else made
    folder.clear()
    return folder


def reopen(path: Path) -> RunFolder:
    """Lock the folder of an existing run; ValueError if another process writes into it."""
    try:
        return RunFolder(path, _lock(path))
    except OSError as error:
        raise ValueError(f"{path} cannot be written to: {error.strerror}.") from None


def _lock(path: Path) -> Lock:
    try:
        return Lock(path)
    except BlockingIOError:
        raise ValueError(f"{path}: another run is being written there. Wait for it, or give another folder.") from None


def _make(folder: Path) -> tuple[Path, ...]:
    """Create a folder and its parents; return those that did not exist."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for one in reversed(missing):
        one.mkdir(exist_ok=True)
    return tuple(reversed(missing))


def _cannot(path: Path, error: OSError) -> ValueError:
    return ValueError(f"--out {path} cannot be a folder: {error.strerror}. Give another one.")
