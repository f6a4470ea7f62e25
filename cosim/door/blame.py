"""Reports mistakes in a user's own class in one line: the file, the line, what happened and what to do."""

import inspect
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_LONGEST = 300
"""Number of characters of an exception's message that are shown."""


class Refused(ValueError):
    """A user's own class cannot be used. The message is one line, and the exit status 2."""


class ExtensionError(RuntimeError):
    """A user's own class failed during a run. The message is one line, and the exit status 1."""


@contextmanager
def at_load(
    file: str,
    place: str,
    what: str,
    line: int = 1,
    passes: type[BaseException] = Refused,
) -> Iterator[None]:
    """Turn any exception of a user's file into `Refused`, including SystemExit. Signals are not changed.

    Parameters
    ----------
    file
        The user's file.
    place
        Key and value of the config, such as `trust.model = mine.py:Beta`.
    what
        What failed.
    line
        Line that the message names if the exception does not come from a line of the file.
    passes
        Exceptions that are not changed because their message is one line already.
    """
    try:
        yield
    except passes:
        raise
    except BaseException as error:  # a user's file can raise anything
        if is_interrupt(error):
            raise
        at = line_of(error, file) or line
        raise Refused(f"{file}:{at}: {place}: {what}: {reason(error)}. cosim --debug shows the traceback.") from error


@contextmanager
def in_use(file: str, what: str) -> Iterator[None]:
    """Turn an exception from a line of a user's file into `ExtensionError`, wherever that line was called from."""
    try:
        yield
    except (Refused, ExtensionError):
        raise
    except Exception as error:  # whatever a user's class does
        line = line_of(error, file)
        if not line:
            raise
        raise ExtensionError(
            f"{file}:{line}: {what} raised {reason(error)}. cosim --debug shows the traceback."
        ) from error


def is_interrupt(error: BaseException) -> bool:
    """Whether an exception comes from a signal (Ctrl-C, or a stop of the run) and not from a user's class."""
    package = type(error).__module__.split(".")[0]
    ours = not isinstance(error, Exception) and package == "cosim"
    return ours or isinstance(error, KeyboardInterrupt)


def line_of(error: BaseException, file: str) -> int:
    """Last line of a file in the traceback of an exception; 0 if the file is not in it."""
    found = 0
    if isinstance(error, SyntaxError) and error.filename == file:
        found = error.lineno or 0
    traceback = error.__traceback__
    while traceback is not None:
        if _is_same_file(traceback.tb_frame.f_code.co_filename, file):
            found = traceback.tb_lineno
        traceback = traceback.tb_next
    return found


def definition_line(of: type, name: str, file: str) -> int:
    """Line of a file that defines a method of a class. If the file does not define the method, the class's line."""
    method = inspect.unwrap(getattr(of, name, of))
    code = getattr(method, "__code__", None)
    if code is not None and _is_same_file(code.co_filename, file):
        return int(code.co_firstlineno)
    with suppress(OSError, TypeError):  # a class without source, such as one of an interactive session
        if _is_same_file(inspect.getsourcefile(of) or "", file):
            return inspect.getsourcelines(of)[1]
    return 1


def _is_same_file(one: str, other: str) -> bool:
    """Whether two names refer to the same file."""
    if one == other:
        return True
    is_named_alike = Path(one).name == Path(other).name  # links are resolved only then, which takes time
    return is_named_alike and _resolved(one) == other


def _resolved(name: str) -> str:
    try:
        return str(Path(name).resolve())
    except OSError:
        return name


def reason(error: BaseException) -> str:
    """An exception in one line."""
    try:
        text = " ".join(str(error).split())
    except BaseException:  # whatever a user's exception does
        text = "its message cannot be shown"
    if isinstance(error, SystemExit):
        text = f"{text}, which ends the program" if text else "it ends the program"
    text = "".join(c if c.isprintable() else "?" for c in text)
    text = text if len(text) <= _LONGEST else text[:_LONGEST] + "..."
    return f"{type(error).__name__}: {text}".rstrip(": .")
