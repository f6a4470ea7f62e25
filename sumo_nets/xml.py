"""Streaming reader of untrusted XML, packed by gzip or bzip2 or not; elements and text only."""

from __future__ import annotations

import bz2
import difflib
import gzip
import io
import re
import stat
import zlib
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, cast
from xml.parsers import expat

Attributes = dict[str, str]

_CHUNK_BYTES = 1 << 16
LARGEST_RATIO = 200
"""Times its size that a compressed file may expand to; SUMO's files reach 30."""
_MOST_NAMES = 2000
"""Names of a folder among which a similar one is searched."""
FREE_BYTES = 100_000_000
"""Size up to which a compressed file may expand at any ratio."""


LONGEST_TAG_BYTES = 8_000_000
"""Longest tag with its attributes. The parser reads an unfinished one again with every chunk."""


class Enough(Exception):
    """Raised by a handler to end the reading."""


def is_true(text: str) -> bool:
    """Whether SUMO takes a value of a file for true."""
    return text.lower() in ("true", "1", "yes", "on", "x", "t")


def stream(
    path: Path | str,
    start: Callable[[str, Attributes], None],
    end: Callable[[str], None] = lambda name: None,
    text: Callable[[str], object] | None = None,
) -> None:
    """Feed every element of an XML file, and the text between them, to the handlers; see `feed`."""
    for _ in feed(path, start, end, text):
        pass


def check_prolog(path: Path | str) -> None:
    """Refuse an XML file that declares a document type, or is no XML at its beginning."""

    def start(name: str, attributes: Attributes) -> None:
        raise Enough

    stream(path, start)


def root_of(path: Path | str) -> str:
    """Name of the first element of an XML file; empty if the file is no XML, or is empty."""
    found: list[str] = []

    def start(name: str, attributes: Attributes) -> None:
        found.append(name)
        raise Enough

    try:
        stream(path, start)
    except ValueError:
        return ""
    return found[0]


def contains(path: Path, text: bytes) -> bool:
    """Whether a file, gzip'ed or not, contains these bytes; much faster than parsing XML."""
    tail = b""
    for chunk in chunks(path):
        if text in tail + chunk:
            return True
        tail = chunk[-len(text) :]
    return False


def chunks(path: Path) -> Iterator[bytes]:
    """The content of a file, gzip'ed or not, piece by piece; ValueError names the file and the cause."""
    try:
        with open_input(path) as file:
            while chunk := file.read(_CHUNK_BYTES):
                yield chunk
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        kind = "bzip2" if Path(path).name.endswith(".bz2") else "gzip"
        raise ValueError(f"{path}: damaged {kind} file ({error})") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None


def feed(
    path: Path | str,
    start: Callable[[str, Attributes], None],
    end: Callable[[str], None] = lambda name: None,
    text: Callable[[str], object] | None = None,
) -> Iterator[None]:
    """`stream` as a generator that yields after every chunk of the file, so that the caller can use its elements.

    SUMO's files need no document type and no entities of their own; a file that declares any is refused,
    so that entities can neither expand without limit nor read other files.

    Raises
    ------
    ValueError
        Names the file and the cause.
    """
    path = Path(path)
    parser = expat.ParserCreate()

    def refuse(*declaration: object) -> int:
        raise ValueError(
            f"{path}, line {parser.CurrentLineNumber}: declares a document type or an entity (<!DOCTYPE ...>), "
            "which SUMO's files never need and which can hide harm. Remove the declaration."
        )

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.ExternalEntityRefHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    if text is not None:
        parser.CharacterDataHandler = text
    n_bytes = 0
    try:
        for chunk in chunks(path):
            parser.Parse(chunk, False)
            n_bytes += len(chunk)
            if n_bytes - parser.CurrentByteIndex > LONGEST_TAG_BYTES:
                raise ValueError(f"a tag with its attributes is longer than {LONGEST_TAG_BYTES:,} bytes")
            yield
        parser.Parse(b"", True)
    except Enough:
        return
    except expat.ExpatError as error:
        cause = expat.ErrorString(error.code)
        raise ValueError(f"{path}, line {error.lineno}: not well-formed XML ({cause})") from None
    except (KeyError, IndexError, TypeError) as error:
        missing = f"no {error.args[0]}" if isinstance(error, KeyError) else f"{error}"
        raise ValueError(f"{path}, line {parser.CurrentLineNumber}: {missing}. Correct the file.") from None
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}, line {parser.CurrentLineNumber}: {error}. Correct the file.") from None


def check_regular(path: Path | str) -> None:
    """Refuse devices, pipes and folders, which could be read for ever; ValueError in one line."""
    try:
        mode = Path(path).stat().st_mode
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not stat.S_ISREG(mode):
        raise ValueError(f"{path}: not a regular file, but a folder, device or pipe. Give a file.")


def version_of(path: Path | str) -> tuple[int, ...]:
    """Numbers that tell the versions of a regular file apart. ValueError in one line if there is no such file."""
    check_regular(path)
    now = Path(path).stat()
    return now.st_dev, now.st_ino, now.st_size, now.st_mtime_ns, now.st_ctime_ns


def exists(path: Path) -> bool:
    """Whether a path exists; False for a name that no file can have."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def meant(folder: Path, name: str) -> Path:
    """The file of a name that an input gives. On Windows, \\ separates folders; here, it is part of a name."""
    given, other = folder / name, folder / name.replace("\\", "/")
    return other if not exists(given) and exists(other) else given


def spelling(path: Path) -> str:
    """What may be wrong with the name of a file that does not exist: a sentence with a blank before it, or nothing."""
    text = str(path)
    if re.search(r"(^|/)[A-Za-z]:[\\/]", text):
        return " It is a path of Windows. Give one of this machine, with / between folders."
    if "\\" in text:
        return " Windows separates folders by \\, this system by /, which works on both."
    folder = Path(path.anchor)
    rest = list(path.parts[1:] if path.anchor else path.parts)
    while rest:
        part = rest.pop(0)
        if not exists(folder / part):
            try:
                names = sorted(entry.name for entry in islice(folder.iterdir(), _MOST_NAMES))
            except OSError:
                return ""
            alike = [name for name in names if name.strip().casefold() == part.strip().casefold()]
            near = alike or difflib.get_close_matches(part, names, 1, 0.85)
            return f" Did you mean {Path(folder / near[0], *rest)}?" if near else ""
        folder = folder / part
    return ""


def open_input(path: Path | str) -> BinaryIO:
    """A regular file for reading, decompressed if it is packed by gzip or bzip2."""
    check_regular(path)
    file = Path(path).open("rb")  # noqa: SIM115
    magic = file.read(3)
    file.seek(0)
    unpacked: Any = gzip.GzipFile(fileobj=file) if magic[:2] == b"\x1f\x8b" else None
    if magic == b"BZh":
        unpacked = bz2.BZ2File(file)
    if unpacked is None:
        return file
    return cast("BinaryIO", io.BufferedReader(_Unpacked(path, file, unpacked), _CHUNK_BYTES))


class _Unpacked(io.RawIOBase):
    """A packed file that refuses to expand beyond what text can be compressed to."""

    def __init__(self, path: Path | str, file: BinaryIO, unpacked: Any) -> None:
        self._path, self._file, self._unpacked = path, file, unpacked
        self._n_bytes = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        content = self._unpacked.read(len(buffer))
        buffer[: len(content)] = content
        self._n_bytes += len(content)
        if self._n_bytes > max(FREE_BYTES, LARGEST_RATIO * self._file.tell()):
            raise ValueError(
                f"{self._path}: expands to more than {LARGEST_RATIO} times its size: damaged, or a decompression bomb."
            )
        return len(content)

    def close(self) -> None:
        self._unpacked.close()
        self._file.close()
        super().close()
