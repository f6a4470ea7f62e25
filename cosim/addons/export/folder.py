"""The folder that an export is written to: nothing outside it, files whole or not at all, resumable."""

import json
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base import durable
from results.moments import File

PROGRESS = "export.progress"
"""JSON; its name is none that readers of a layout look for."""

PARTIAL = ".partial"


@dataclass(slots=True)
class Folder:
    """Where an export goes, and which of its units are done."""

    path: Path
    about: dict[str, Any]
    """What is exported; an export that differs in it is another one."""
    done: list[str] = field(default_factory=list)
    _made: set[Path] = field(default_factory=set)

    @staticmethod
    def open(path: Path, about: dict[str, Any]) -> "Folder":
        """A new or empty folder, or one in which this very export was begun; ValueError in one line otherwise."""
        about = json.loads(json.dumps(about))
        try:
            path.mkdir(parents=True, exist_ok=True)
            folder = Folder(path.resolve(), about)
            if (path / PROGRESS).is_file():
                before = json.loads((path / PROGRESS).read_text(encoding="utf-8"))
                other = before["about"]
                if other != about:
                    changed = ", ".join(k for k in about if other.get(k) != about[k])
                    raise ValueError(f"--out {path} holds another export (other {changed}). Give another folder.")
                folder.done = list(before["done"])
            elif any(path.iterdir()):
                raise ValueError(f"--out {path} is not empty. Give a new folder.")
        except (OSError, KeyError, TypeError, json.JSONDecodeError) as error:
            raise ValueError(f"--out {path} cannot be used: {getattr(error, 'strerror', None) or error}.") from None
        return folder

    def check_room(self, n_bytes: float) -> None:
        """ValueError in one line where the disk has no room for so much."""
        free = shutil.disk_usage(self.path).free
        if n_bytes > free:
            raise ValueError(
                f"--out {self.path}: about {n_bytes / 1e9:.2g} GB are to be written, and {free / 1e9:.2g} GB are free. "
                "Choose fewer vehicles or steps (--vehicles, --steps), or another disk."
            )

    def write(self, file: File) -> int:
        """Write one file; its length [B]."""
        path = self.path / file.path
        try:
            self._make_parent(path)
            partial = path.with_name(path.name + PARTIAL)
            if file.same_as:
                partial.unlink(missing_ok=True)
                _link(self.path / file.same_as, partial)
            else:
                content = _content(file)
                with open(durable.new_file(partial), "wb") as opened:
                    opened.write(content)
            partial.replace(path)
            return 0 if file.same_as else path.stat().st_size
        except OSError as error:
            raise ValueError(
                f"{path} cannot be written: {error.strerror}. Mend that, and give the same command: it goes on there."
            ) from None

    def finish(self, unit: str) -> None:
        """Note that all files of a unit are written."""
        self.done.append(unit)
        self.note()

    def note(self) -> None:
        """Write down what is exported and what of it is done. From then on the export can be continued."""
        content = json.dumps({"about": self.about, "done": self.done}, indent=1)
        self.write(File(PROGRESS, content.encode))

    def _make_parent(self, path: Path) -> None:
        parent = path.parent
        if parent not in self._made:
            if ".." in path.parts or not parent.resolve().is_relative_to(self.path):
                raise ValueError(f"{path} lies outside of {self.path}. Give a folder without links to others.")
            parent.mkdir(parents=True, exist_ok=True)
            self._made.add(parent)


def _content(file: File) -> bytes:
    content = file.content()
    if not isinstance(content, bytes):
        raise ValueError(f"{file.path}: its content is {type(content).__name__}, not bytes. Write text.encode().")
    return content


def _link(source: Path, path: Path) -> None:
    """A hard link, or a copy where the file system has none."""
    try:
        os.link(source, path)
    except OSError:
        shutil.copyfile(source, path)
