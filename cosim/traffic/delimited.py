"""Text tables: header, separator, and columns of text block by block; the numbers and times that the texts mean."""

import csv
import re
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv
from jaxtyping import Float
from numpy import ndarray

from cosim.traffic.frame import TrafficError
from sumo_nets.xml import open_input

_SEPARATORS = ";,\t|"
_BLOCK_BYTES = 1 << 22
_HEAD_BYTES = 1 << 16
_NOTHING = ("", "NA", "N/A", "#N/A", "na", "n/a", "null", "NULL", "None", "nan", "NaN", "NAN", "-")
"""Texts for a number that is missing."""
_NUMBER = r"^[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?$"
_DATE = r"^\d{4}-\d\d-\d\d[ T]\d\d:\d\d"
_CLOCK = r"^(?P<d>\d+:)?(?P<h>\d{1,3}):(?P<m>\d\d):(?P<s>\d\d(?:[.,]\d+)?)$"
"""Times of day, as SUMO writes them with --human-readable-time; days come first."""
_RAGGED = re.compile(r"Expected (\d+) columns, got (\d+): ?(.*)")
ENDS_EARLY = "SUMO was stopped, or still writes it. Let it end, or record the trace again"


@dataclass(frozen=True, slots=True)
class Header:
    """The first line of a text table."""

    names: list[str]
    """Names of the columns, without blanks and quotes around them."""
    separator: str

    @property
    def is_data(self) -> bool:
        """Whether a name is a number, a date or a time: the file has no header, and this is its first row."""
        is_value = re.compile(f"{_NUMBER}|{_DATE}|{_CLOCK}")
        return any(is_value.match(name) for name in self.names)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Read a file, gzip'ed or not. What is wrong with it is told as a TrafficError."""
    try:
        with open_input(path) as source:
            yield source
    except EOFError:
        raise TrafficError(f"{path}: the gzip file ends early. {ENDS_EARLY}.") from None
    except (OSError, zlib.error) as error:
        raise TrafficError(f"{path}: cannot be read ({str(error).splitlines()[0]}).") from None
    except ValueError as error:
        raise TrafficError(str(error)) from None


def first_line(path: Path) -> str:
    """The first line of a text file, gzip'ed or not, without blanks around it. Raises TrafficError."""
    with _opened(path) as source:
        head = source.read(_HEAD_BYTES)
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise TrafficError(f"{path}: its text is UTF-16. Save it as UTF-8.")
    if b"\n" not in head and b"\r" in head.rstrip(b"\r"):
        raise TrafficError(f"{path}: its lines end with CR alone. Save it with lines that end with LF, or CR and LF.")
    return head.partition(b"\n")[0].decode(errors="replace").strip().lstrip("\ufeff")


def header(path: Path) -> Header:
    """Names and separator of a text table. Raises TrafficError."""
    line = first_line(path)
    separator = next((s for s in _SEPARATORS if s in line), " " if " " in line else ",")
    if separator == " ":
        names = line.split()
    else:
        names = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    names = [name.strip().strip('"') for name in names]
    if len(names) > 1 and not names[-1]:
        names = names[:-1]
    return Header(names, separator)


def check_header(path: Path, found: Header, wanted: Collection[str]) -> None:
    """Raise TrafficError if the file has no header, or has one of these columns twice."""
    if found.is_data:
        raise TrafficError(
            f"{path}: no header line: it begins with {', '.join(found.names[:4])[:80]}. Put a line with the names of "
            "the columns in front, such as id,time,x,y in metres or id,time,lat,lon in degrees."
        )
    if twice := sorted({name for name in wanted if found.names.count(name) > 1}):
        raise TrafficError(f"{path}: its header has the column {twice[0]} twice. Remove one of them.")


def blocks(path: Path, found: Header, wanted: Collection[str], has_header: bool = True) -> Iterator[pa.Table]:
    """Columns as text, without blanks around the values, a few megabytes of the file at a time.

    The file is cut into whole lines here, and not by Arrow, whose threads outlive an error and then abort the process.

    Raises
    ------
    TrafficError
        The file is damaged, or a row has more or fewer values than the header has names.
    """
    separator = re.escape(found.separator.encode())
    for lines, is_torn in _whole_lines(path, has_header):
        if found.separator == " ":
            lines = re.sub(rb"(?m)^ +| +(?=\r?$)| (?= )", b"", lines)
        try:
            try:
                table = _parsed(lines, found, wanted)
            except pa.ArrowInvalid:  # a separator at the end of each row as well
                table = _parsed(re.sub(rb"(?m)" + separator + rb"[ \t]*(?=\r?$)", b"", lines), found, wanted)
        except pa.ArrowException as error:
            raise TrafficError(f"{path}: {_unreadable(str(error), is_torn)}") from None
        yield pa.table({name: _plain(table.column(name)) for name in wanted})


def _parsed(lines: bytes, found: Header, wanted: Collection[str]) -> pa.Table:
    return pcsv.read_csv(
        pa.BufferReader(lines),
        pcsv.ReadOptions(column_names=found.names, use_threads=False, block_size=len(lines) + 1),
        pcsv.ParseOptions(delimiter=found.separator),
        pcsv.ConvertOptions(
            include_columns=list(wanted),
            column_types=dict.fromkeys(wanted, pa.string()),
            strings_can_be_null=True,
            quoted_strings_can_be_null=False,
            null_values=[""],
        ),
    )


def _whole_lines(path: Path, has_header: bool) -> Iterator[tuple[bytes, bool]]:
    """The lines after the header, in blocks that end at the end of a line, and whether a line lacks its end."""
    with _opened(path) as source:
        if has_header:
            source.readline(_HEAD_BYTES)
        left = b""
        while chunk := source.read(_BLOCK_BYTES):
            whole, end, rest = (left + chunk).rpartition(b"\n")
            if whole.strip():
                yield whole + end, False
            left = rest if end else left + chunk
            if len(left) > 4 * _BLOCK_BYTES:
                raise TrafficError(f"{path}: a line of more than {len(left) >> 20} MB: no table of text.")
        if left.strip():
            yield left, True


def _unreadable(said: str, is_torn: bool) -> str:
    """What is wrong with a row, in place of Arrow's words."""
    if (ragged := _RAGGED.search(said.replace("\n", " "))) is None:
        cause = "text that is not UTF-8" if "UTF8" in said else said.splitlines()[0]
        return f"cannot be read as a table: {cause}. Correct the file."
    n, got, row = ragged[1], ragged[2], ragged[3][:60]
    if is_torn:
        return f"its last row is not complete ({row}): the file ends early. {ENDS_EARLY}."
    return (
        f"a row has {got} values and the header has {n} names ({row}): rows of any length are not read. Write a row "
        f"per vehicle and time, each with {n} values."
    )


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Text without blanks, and then quotes, around it."""
    text = pc.utf8_trim_whitespace(column)
    if pc.any(pc.starts_with(text, '"')).as_py():
        text = pc.replace_substring_regex(text, r'^"(.*)"$', r"\1")
    return pc.if_else(pc.equal(text, ""), None, text)


def is_text(kind: pa.DataType) -> bool:
    """Whether a column holds text."""
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def texts(path: Path, name: str, column: pa.ChunkedArray) -> pa.ChunkedArray:
    """A column as text. Raises TrafficError."""
    try:
        return column.cast(pa.string())
    except pa.ArrowException:
        raise TrafficError(f"{path}: column {name} holds something that is no text and no number.") from None


def numbers(path: Path, name: str, column: pa.ChunkedArray, first_row: int = 0) -> Float[ndarray, "n"]:
    """Numbers of a column; not a number where one is missing. Decimal commas are read.

    Parameters
    ----------
    first_row
        Row of the table at which the column begins, for error messages.

    Raises
    ------
    TrafficError
        Names the first value that is no number, and its row.
    """
    try:
        if not is_text(column.type):  # integers above 2^53, such as nanoseconds since 1970, are rounded
            return column.cast(pa.float64(), safe=not pa.types.is_integer(column.type)).to_numpy()
        given = pc.if_else(pc.is_in(column, pa.array(_NOTHING)), None, column)
        try:
            return given.cast(pa.float64()).to_numpy()
        except pa.ArrowInvalid:
            has_comma = pc.fill_null(pc.match_substring(given, ","), False)
            has_point = pc.fill_null(pc.match_substring(given, "."), False)
            if pc.any(has_comma).as_py() and not pc.any(has_point).as_py():
                return pc.replace_substring(given, ",", ".").cast(pa.float64()).to_numpy()
            raise
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        raise TrafficError(
            f"{path}: column {name} holds something that is not a number{_first_bad(column, first_row)}."
        ) from None


def _first_bad(column: pa.ChunkedArray, first_row: int) -> str:
    """The first value of a column that is no number, with its place."""
    if not is_text(column.type):
        return ", but dates, times or lists"
    for row, text in enumerate(column.to_pylist()):
        if text is None or text in _NOTHING:
            continue
        if re.match(_NUMBER, text) and "," not in text:
            continue
        hint = ""
        if re.match(r"^[-+]?\d{1,3}([.,']\d{3})+([.,]\d+)?$", text):
            hint = ". Are commas or points between thousands? Remove them"
        elif "," in text:
            hint = ". Is it a decimal comma? Write decimal points in all rows"
        return f": {text[:40]!r} in row {first_row + row + 1}{hint}"
    return ""


def seconds(
    path: Path, name: str, column: pa.ChunkedArray, unit_s: float = 1.0, first_row: int = 0
) -> Float[ndarray, "n"]:
    """Seconds of a column with numbers, times of day such as 00:00:05, or dates with times, which are since 1970.

    A date without a zone is taken as UTC.

    Parameters
    ----------
    unit_s
        Seconds per unit of a number.

    Raises
    ------
    TrafficError
        Names the first value that is none of these.
    """
    kind = column.type
    if pa.types.is_time(kind) or pa.types.is_duration(kind):
        in_microseconds = pa.time64("us") if pa.types.is_time(kind) else pa.duration("us")
        microseconds = column.cast(in_microseconds).cast(pa.int64())
        return microseconds.cast(pa.float64(), safe=False).to_numpy() / 1e6
    if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
        return _since_1970(path, name, column)
    if not is_text(kind):
        return numbers(path, name, column, first_row) * unit_s
    first = next((text for text in column.to_pylist() if text is not None), "")
    if re.match(_CLOCK, first):
        return _of_day(path, name, column)
    if re.match(_DATE, first):
        return _since_1970(path, name, column)
    if first and first not in _NOTHING and not re.match(_NUMBER, first):
        raise _no_time(path, name, first)
    return numbers(path, name, column, first_row) * unit_s


def clock_seconds(text: str) -> float | None:
    """Seconds of a time of day such as 00:00:05 or 1:00:00:05; None if the text is none."""
    found = re.match(_CLOCK, text)
    if found is None:
        return None
    parts = [part.rstrip(":").replace(",", ".") for part in found.groups("0")]
    d, h, m, s = map(float, parts)
    return ((d * 24 + h) * 60 + m) * 60 + s


def _of_day(path: Path, name: str, column: pa.ChunkedArray) -> Float[ndarray, "n"]:
    _check_form(path, name, column, _CLOCK)
    parts = pa.chunked_array(pc.extract_regex(column, _CLOCK)).combine_chunks()
    total = np.zeros(len(column))
    for part, unit_s in zip("dhms", (86400.0, 3600.0, 60.0, 1.0), strict=True):
        text = pc.replace_substring(pc.utf8_rtrim(parts.field(part), ":"), ",", ".")
        number = pc.if_else(pc.equal(text, ""), "0", text).cast(pa.float64())
        total += unit_s * number.to_numpy(zero_copy_only=False)
    return np.where(np.asarray(column.is_null()), np.nan, total)


def _since_1970(path: Path, name: str, column: pa.ChunkedArray) -> Float[ndarray, "n"]:
    if is_text(column.type):
        _check_form(path, name, column, _DATE)
    import pandas as pd  # imported here because most traces have seconds

    try:
        parsed = pd.to_datetime(column.to_pandas(), utc=True, format="ISO8601", errors="raise")
    except (ValueError, TypeError) as error:
        cause = " ".join(str(error).split()).partition(". You might")[0][:120]
        raise TrafficError(f"{path}: column {name}: {cause}.") from None
    microseconds = parsed.dt.tz_localize(None).dt.as_unit("us").to_numpy()
    return np.where(np.isnat(microseconds), np.nan, microseconds.astype(np.int64) / 1e6)


def _check_form(path: Path, name: str, column: pa.ChunkedArray, form: str) -> None:
    """Raise TrafficError if a text of a column has not this form."""
    is_right = pc.fill_null(pc.match_substring_regex(column, form), True)
    if not pc.all(is_right).as_py():
        raise _no_time(path, name, column.filter(pc.invert(is_right))[0].as_py())


def _no_time(path: Path, name: str, text: str) -> TrafficError:
    return TrafficError(
        f"{path}: column {name} holds {text[:40]!r}, which is neither a number of seconds nor a date with a time, such "
        "as 2014-02-01 00:00:00, nor a time of day, such as 00:00:05. Correct it, or name another column."
    )
