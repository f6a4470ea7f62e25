"""A SUMO configuration: the files that it reads, its harmless options, and its step length."""

from __future__ import annotations

import difflib
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from urllib.parse import quote, unquote
from xml.sax.saxutils import quoteattr

from sumo_nets.sumo_inputs import check_input
from sumo_nets.sumo_options import IGNORED, PASSED, READS, REFUSED, SYNONYMS
from sumo_nets.xml import (
    Attributes,
    Enough,
    check_regular,
    contains,
    exists,
    is_true,
    meant,
    root_of,
    spelling,
    stream,
)

SUFFIXES = (".sumocfg", ".sumo.cfg")
"""File name endings of configurations that SUMO's users write."""
ROOTS = frozenset(("configuration", "sumoConfiguration"))
"""First elements of a configuration of SUMO."""

_REQUIRED = ("net-file", "route-files", "additional-files")
"""Options whose files are checked for existence; SUMO itself reports others."""
_POLY = ["<poly".encode(encoding) for encoding in ("utf-8", "utf-16-le", "utf-16-be")]
_DEMAND = [b"<flow", b"<trip", b"<vehicle ", b"<person"]
_TABLES = ("astar.all-distances", "astar.landmark-distances")
"""Options whose files SUMO reads as tables, and not as XML."""


@dataclass(frozen=True, slots=True)
class Sumocfg:
    """The parts of a configuration that a run needs."""

    path: Path
    files: dict[str, tuple[Path, ...]]
    """By option, in the order given."""
    options: dict[str, str]
    """Values of options that change the traffic only."""
    included: tuple[Path, ...]
    """Files that its files include."""

    @property
    def net(self) -> Path:
        return self.files["net-file"][0]

    @property
    def additional(self) -> tuple[Path, ...]:
        return self.files["additional-files"]

    @property
    def routes(self) -> tuple[Path, ...]:
        return self.files["route-files"]

    @property
    def demand(self) -> tuple[Path, ...]:
        """The files with vehicles and persons. Additional files may contain them, too."""
        others = dict.fromkeys((*self.additional, *self.included))
        found = [path for path in others if any(contains(path, text) for text in _DEMAND)]
        return (*self.routes, *found)

    @property
    def buildings(self) -> tuple[Path, ...]:
        """The additional files, and the files that files include, that contain polygons."""
        files = dict.fromkeys((*self.additional, *self.included))
        return tuple(path for path in files if any(contains(path, text) for text in _POLY))

    @property
    def switches(self) -> frozenset[str]:
        """The options that are switched on."""
        return frozenset(name for name, value in self.options.items() if is_true(value))

    @property
    def begin_s(self) -> float:
        """When the simulation begins [s]; 0 if it does not say so, or says no time, which SUMO refuses."""
        try:
            return seconds(self.options.get("begin", "0"))
        except ValueError:
            return 0.0

    @property
    def scale(self) -> float:
        """The factor on the demand.

        Raises
        ------
        ValueError
            It is no number, or not finite.
        """
        text = self.options.get("scale", "1")
        try:
            found = float(text)
        except ValueError:
            raise ValueError(f"{self.path}: scale = {text} is no number. Correct or remove it.") from None
        if not math.isfinite(found):
            raise ValueError(f"{self.path}: scale = {text} is no factor of a demand. Correct or remove it.")
        return found

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Every file that is read, the configuration first."""
        named = chain.from_iterable(self.files.values())
        return tuple(dict.fromkeys((self.path, *named, *self.included)))

    def text(self) -> str:
        """A configuration with these files, by absolute path, and these options, and nothing else."""
        values = {}
        for name, paths in self.files.items():
            if paths:
                values[name] = ",".join(quote(str(path.absolute())) for path in paths)
        values |= self.options
        lines = [f"    <{name} value={quoteattr(value)}/>\n" for name, value in values.items()]
        return "<configuration>\n" + "".join(lines) + "</configuration>\n"


def read(path: Path) -> Sumocfg:
    """Read a .sumocfg, and check its options, and that every file that it names exists and is harmless.

    Raises
    ------
    ValueError
        Names the configuration, the option or file, and the cause.
    """
    values = _values(path)
    options: dict[str, str] = {}
    for name, value in values.items():
        if name in REFUSED:
            raise ValueError(f"{path}: the option {name} is refused: with it SUMO {REFUSED[name]}. Remove it.")
        if name in PASSED:
            options[name] = value
        elif name not in IGNORED and name not in READS:
            near = difflib.get_close_matches(name, (*READS, *PASSED, *IGNORED), 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise ValueError(f"{path}: SUMO 1.28 has no option {name}.{hint} Correct or remove it.")
    files = {option: _files(path.parent, values[option]) for option in READS if option in values}
    files = {option: files.get(option, ()) for option in (*_REQUIRED, *files)}
    if not files["net-file"]:
        raise ValueError(f'{path}: names no network. Add <net-file value="..."/> to its <input>.')
    if len(files["net-file"]) > 1:
        names = ",".join(file.name for file in files["net-file"])
        raise ValueError(f"{path}: names several networks. Join them: netconvert -s {names} -o joined.net.xml")
    included: list[Path] = []
    for option, named in files.items():
        for file in named:
            if not exists(file):
                what = "names" if option in _REQUIRED else f"{option} names"
                cure = spelling(file) or " Correct the path in the .sumocfg."
                raise ValueError(f"{path}: {what} {file}, which does not exist.{cure}")
            if option in _TABLES:
                check_regular(file)
            else:
                included += check_input(file)
    return Sumocfg(path, files, options, tuple(included))


def is_sumocfg(path: Path) -> bool:
    """Whether a file is a configuration of SUMO, whatever its name: `*.sumo.cfg` is as usual as `*.sumocfg`."""
    return path.is_file() and (path.name.endswith(SUFFIXES) or root_of(path) in ROOTS)


def without_commas(config: Sumocfg, folder: Path) -> Sumocfg:
    """The configuration with its files by way of links in `folder`, where the name of their own folder has a comma.

    SUMO splits every list of files at commas, and knows no way to write one.
    """
    links: dict[Path, Path] = {}

    def linked(path: Path) -> Path:
        own = path.absolute().parent
        if "," not in str(own):
            return path
        if own not in links:
            links[own] = folder / f"inputs-{len(links)}"
            links[own].symlink_to(own, target_is_directory=True)
        return links[own] / path.name

    files = {option: tuple(map(linked, paths)) for option, paths in config.files.items()}
    return replace(config, files=files)


def in_folder(folder: Path) -> list[Path]:
    """The configurations in a folder; those of other names only if there is no .sumocfg."""
    return sorted(folder.glob("*.sumocfg")) or sorted(filter(is_sumocfg, folder.glob("*.cfg")))


def seconds(text: str) -> float:
    """A time as SUMO reads it [s]: seconds, or hours, minutes and seconds, or days before these.

    Raises
    ------
    ValueError
        It is none.
    """
    parts = [float(part) for part in text.split(":")]
    if len(parts) not in (1, 3, 4):
        raise ValueError(f"{text} is no time.")
    units_s = (86400, 3600, 60, 1)[-len(parts) :]
    return sum(part * unit_s for part, unit_s in zip(parts, units_s, strict=True))


def step_s(path: Path) -> float:
    """Length of a step [s]; SUMO's default of 1 s where the configuration has none, or none that is a time."""
    try:
        return seconds(_values(path).get("step-length", "1"))
    except ValueError:
        return 1.0


def first_departure_s(routes: Iterable[Path]) -> float | None:
    """The earliest departure among the first of each route file [s]; SUMO wants them sorted. None without any."""
    found: list[float] = []

    def start(name: str, attributes: Attributes) -> None:
        text = attributes.get("depart", attributes.get("begin", ""))
        if name in ("vehicle", "trip", "flow", "person", "personFlow") and text[:1].isdigit():
            found.append(seconds(text))
            raise Enough

    for path in routes:
        stream(path, start)
    return min(found, default=None)


def _values(path: Path) -> dict[str, str]:
    """Values of the options of a configuration, by name; sections and empty options are left out."""
    values: dict[str, str] = {}
    text: list[str] = []

    def start(name: str, attributes: Attributes) -> None:
        text.clear()
        value = attributes.get("value", attributes.get("v"))
        if value is not None:
            values[SYNONYMS.get(name, name)] = value

    def end(name: str) -> None:
        if written := "".join(text).strip():
            values[SYNONYMS.get(name, name)] = written
        text.clear()

    stream(path, start, end, text.append)
    return {name: value for name, value in values.items() if value}


def _files(folder: Path, value: str) -> tuple[Path, ...]:
    written = map(str.strip, value.replace(";", ",").split(","))
    parts = [unquote(os.path.expandvars(part)) for part in written]
    return tuple(meant(folder, part) for part in parts if part)
