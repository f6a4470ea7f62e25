"""Tests, and what developers run beside them."""
