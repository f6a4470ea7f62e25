"""Cases of a test that `make verify` carries out and `make test` leaves out."""

import pytest


def slow(*values):
    """A case of `pytest.mark.parametrize`."""
    return pytest.param(*values, marks=pytest.mark.verify)
