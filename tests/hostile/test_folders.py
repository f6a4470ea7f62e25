"""Damaged run folders: every harm is found by `verify`, and no metric or figure comes of it unsaid."""

import random
import shutil

import pytest

from results.verify import verify
from tests.drive import drive
from tests.hostile.folders import HARMS


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that is whole."""
    folder = drive(tmp_path_factory.mktemp("whole") / "run", "record.block_steps=10")
    assert verify(folder)[1] == []
    return folder


@pytest.mark.parametrize("harm", sorted(set(HARMS), key=lambda h: h.__name__), ids=lambda h: h.__name__)
def test_each_harm_is_found(whole, tmp_path, harm):
    shutil.copytree(whole, tmp_path / "run")
    said = harm(tmp_path / "run", random.Random(3))
    assert verify(tmp_path / "run")[1], said
