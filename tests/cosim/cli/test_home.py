"""A user without a home folder, as in containers."""

import os
import pwd
from pathlib import Path

import pytest

from cosim.cli import main


def test_a_user_without_a_home_has_a_temporary_one(monkeypatch):
    monkeypatch.delenv("HOME")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", lambda _uid: (_ for _ in ()).throw(KeyError("no such user")))
    seen = []
    with pytest.raises(SystemExit):
        main.main(lambda **_: seen.append(Path.home()))
    monkeypatch.setenv("HOME", os.environ["HOME"])  # `main` has set it
    assert seen and not seen[0].exists()
