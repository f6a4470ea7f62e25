"""Runs as the tests of `results` have them."""

from tests.results.conftest import other, run, tiny

__all__ = ["other", "run", "tiny"]
