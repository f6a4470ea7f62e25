"""Which code made a run: the version, the commit of a checkout, and a hash of the installed code."""

import hashlib
import subprocess
from functools import cache
from pathlib import Path

from cosim import __version__

_ROOT = Path(__file__).parents[2]
_PACKAGES = ("cosim", "sensors", "trust", "results", "sumo_nets")
_COMPUTES = (".py", ".toml", ".csv")
"""Suffixes of code, and of the data that it computes with, such as profiles of detectors."""


@cache
def code_digest() -> str:
    """Hash of the code of all packages and of its data, twelve digits. Equal installations have the same hash."""
    found = hashlib.sha256()
    for package in _PACKAGES:
        for path in sorted((_ROOT / package).rglob("*.*")):
            if path.suffix in _COMPUTES:
                found.update(path.relative_to(_ROOT).as_posix().encode() + path.read_bytes())
    return found.hexdigest()[:12]


@cache
def source() -> dict[str, str]:
    """For the manifest: `version`; `code`, the hash of the source; and in a checkout `commit`, marked if changed."""
    found = {"version": __version__, "code": code_digest()}
    if not (_ROOT / ".git").exists():
        return found
    try:
        asked = ["git", "-C", str(_ROOT), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=, changed"]
        said = subprocess.run(asked, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):  # there is no git, or the checkout belongs to another user
        return found
    return found | {"commit": said}
