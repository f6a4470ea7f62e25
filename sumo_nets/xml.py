"""Streaming reader of untrusted XML, gzip'ed or not; elements and text only."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, cast
from xml.parsers import expat

Attributes = dict[str, str]

_CHUNK_BYTES = 1 << 16


class Enough(Exception):
    """Raised by a handler to end the reading."""


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


def contains(path: Path, text: bytes) -> bool:
    """Whether a file, gzip'ed or not, contains these bytes; much faster than parsing XML."""
    tail = b""
    with _open(path) as file:
        while chunk := file.read(_CHUNK_BYTES):
            if text in tail + chunk:
                return True
            tail = chunk[-len(text) :]
    return False


def feed(
    path: Path | str,
    start: Callable[[str, Attributes], None],
    end: Callable[[str], None] = lambda name: None,
    text: Callable[[str], object] | None = None,
) -> Iterator[None]:
    """The same as a generator that yields after every chunk of the file, so that the caller can use its elements.

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
    try:
        with _open(path) as file:
            while chunk := file.read(_CHUNK_BYTES):
                parser.Parse(chunk, False)
                yield
        parser.Parse(b"", True)
    except Enough:
        return
    except expat.ExpatError as error:
        cause = expat.ErrorString(error.code)
        raise ValueError(f"{path}, line {error.lineno}: not well-formed XML ({cause})") from None
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ValueError(f"{path}: damaged gzip file ({error})") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None


def _open(path: Path) -> IO[bytes]:
    with path.open("rb") as file:
        zipped = file.read(2) == b"\x1f\x8b"
    return cast("IO[bytes]", gzip.open(path, "rb")) if zipped else path.open("rb")
