"""The town of the tests of misbehaviour."""

from tests.results.test_misbehaviour import town  # noqa: F401
