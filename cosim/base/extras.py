"""Libraries that only some features need; they come with an extra of the package."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needed(library: str, purpose: str, extra: str) -> Iterator[None]:
    """Import an optional library inside; where it is missing, one line says how to install it.

    Parameters
    ----------
    library
        Name of the package.
    purpose
        What it does here, as the subject and verb of a sentence: "writes MCAP files".
    extra
        Extra of this package that brings it.

    Raises
    ------
    ValueError
        In one line: the library is not installed.
    """
    try:
        yield
    except ImportError:
        raise ValueError(
            f"{library} {purpose}, and it is not installed. "
            f"Install it: make extra NAME={extra} in a checkout, else pip install 'cosim-perception[{extra}]'."
        ) from None
