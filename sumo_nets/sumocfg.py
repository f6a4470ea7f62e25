"""A SUMO configuration: the files that it reads, those that it would write, and its step length."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from sumo_nets.xml import Attributes, check_prolog, contains, stream

_SYNONYMS = {
    "net": "net-file", "n": "net-file", "additional": "additional-files", "a": "additional-files",
    "routes": "route-files", "r": "route-files", "b": "begin", "e": "end", "log-file": "log", "l": "log",
    "ndump": "netstate-dump", "netstate": "netstate-dump", "netstate-output": "netstate-dump",
    "person-fcd": "person-fcd-output", "summary": "summary-output", "tripinfo": "tripinfo-output",
    "personinfo": "personinfo-output", "vehroutes": "vehroute-output", "personroutes": "personroute-output",
    "statistics-output": "statistic-output",
}  # fmt: skip
_READ = ("net-file", "additional-files", "route-files")
_WRITTEN = ("netstate-dump", "log", "message-log", "error-log")


@dataclass(frozen=True, slots=True)
class Sumocfg:
    """The parts of a configuration that a run needs."""

    path: Path
    net: Path
    additional: tuple[Path, ...]
    routes: tuple[Path, ...]
    outputs: tuple[str, ...]
    """Options in it that would write a file."""

    @property
    def buildings(self) -> tuple[Path, ...]:
        """The additional files that contain polygons."""
        return tuple(path for path in self.additional if contains(path, b"<poly"))


def read(path: Path) -> Sumocfg:
    """Read a .sumocfg, and check that every file that it names exists and is harmless.

    Raises
    ------
    ValueError
        Names the configuration, the file and the cause.
    """
    values = _values(path)
    found = {option: _files(path.parent, values.get(option, "")) for option in _READ}
    if not found["net-file"]:
        raise ValueError(f'{path}: names no network. Add <net-file value="..."/> to its <input>.')
    for named in found.values():
        for file in named:
            if not file.is_file():
                raise ValueError(f"{path}: names {file}, which does not exist. Correct the path in the .sumocfg.")
            check_prolog(file)
    outputs = tuple(
        name for name, value in values.items() if value and (name.endswith(("-output", ".output")) or name in _WRITTEN)
    )
    return Sumocfg(path, found["net-file"][0], found["additional-files"], found["route-files"], outputs)


def step_s(path: Path) -> float:
    """Length of a step [s]; SUMO's default of 1 s where the configuration has none, or none that is a number."""
    try:
        return float(_values(path).get("step-length", "1"))
    except ValueError:
        return 1.0


def _values(path: Path) -> dict[str, str]:
    """Values of the options of a configuration, by name."""
    values: dict[str, str] = {}
    text: list[str] = []

    def start(name: str, attributes: Attributes) -> None:
        text.clear()
        values[_SYNONYMS.get(name, name)] = attributes.get("value", attributes.get("v", ""))

    def end(name: str) -> None:
        if written := "".join(text).strip():
            values[_SYNONYMS.get(name, name)] = written
        text.clear()

    stream(path, start, end, text.append)
    return values


def _files(folder: Path, value: str) -> tuple[Path, ...]:
    parts = (unquote(os.path.expandvars(part.strip())) for part in value.replace(";", ",").split(","))
    return tuple(folder / part for part in parts if part)
