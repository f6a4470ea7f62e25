"""Tests, and what developers run beside them."""

from pathlib import Path

SHARED = Path(__file__).resolve().parents[2] / "shared"
"""Reference data and networks beside the checkout. Tests that need them skip where the folder is absent."""
