"""Wheels of all pinned packages, by resolution against the package index; skipped without uv or without the index."""

import shutil

import pytest

from tests.verification.platforms import EXTRAS, PLATFORMS, PYTHONS, ROOT, lacking

PAGE = (ROOT / "cosim/docs/pages/reference/platforms.md").read_text(encoding="utf-8")


def test_the_page_names_the_versions_of_python():
    assert all(python in PAGE for python in PYTHONS) and all(
        f"`{extra}`" in PAGE for extra in ("embree", "build", "view")
    )
    assert set(EXTRAS) == {"build", "view", "embree", "mesh", "formats"} and len(PLATFORMS) == 6


@pytest.mark.verify
@pytest.mark.parametrize("platform", ["Linux, x86-64", "Linux, ARM", "macOS 15, ARM", "Windows, x86-64"])
def test_a_run_has_wheels(platform):
    if shutil.which("uv") is None:
        pytest.skip("uv is not installed")
    if lacking(["tomli-w"], "Linux, x86-64", "3.12"):
        pytest.skip("the package index cannot be reached")
    assert lacking(["-r", "requirements.lock"], platform, "3.12") == ""
