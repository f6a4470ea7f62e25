"""What a mistake is answered with: one line."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def refused_in_one_line(match: str | re.Pattern[str]) -> Iterator[None]:
    """The statement raises a ValueError of one line that matches."""
    with pytest.raises(ValueError, match=match) as caught:
        yield
    assert "\n" not in str(caught.value)
