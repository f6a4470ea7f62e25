"""Which platforms have wheels for what a run needs, by resolution against the package index.

    python -m tests.verification.platforms

It needs uv, which resolves for other platforms. Nothing is downloaded or installed. The page
`cosim/docs/pages/reference/platforms.md` holds the answer with its date.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[2]
PLATFORMS: Mapping[str, tuple[str, str]] = {
    "Linux, x86-64": ("x86_64-manylinux_2_28", ""),
    "Linux, ARM": ("aarch64-manylinux_2_28", ""),
    "macOS 15, ARM": ("aarch64-apple-darwin", "15.0"),
    "macOS 14, ARM": ("aarch64-apple-darwin", "14.0"),
    "macOS 15, Intel": ("x86_64-apple-darwin", "15.0"),
    "Windows, x86-64": ("x86_64-pc-windows-msvc", ""),
}
"""uv's name and the version of macOS, by platform. glibc 2.28 is that of RHEL 8 and Debian 10."""
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
EXTRAS: Mapping[str, tuple[str, ...]] = {
    "build": ("eclipse-sumo", "osmium", "sumolib"),
    "view": ("rerun-sdk",),
    "embree": ("embreex",),
    "mesh": ("trimesh",),
    "formats": ("mcap",),
}
"""Packages of each extra. What they need themselves is pure Python or in every run."""


def lacking(wanted: list[str], platform: str, python: str) -> str:
    """The first package of which uv says that it has no wheel for a platform; empty if all have one."""
    name, macos = PLATFORMS[platform]
    with tempfile.TemporaryDirectory() as target:
        words = [
            "uv", "pip", "install", "--dry-run", "--quiet", "--no-deps", "--target", target, "--python-platform", name,
            "--python-version", python, "--only-binary", ":all:", *wanted,
        ]  # fmt: skip
        environment = os.environ | ({"MACOSX_DEPLOYMENT_TARGET": macos} if macos else {})
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    if done.returncode == 0:
        return ""
    said = " ".join(done.stderr.split())
    found = re.search(r"([\w.-]+==[\w.]+) has no", said)
    return found[1] if found else said[:200]


def answers() -> Iterator[tuple[str, str, str, dict[str, str]]]:
    """Platform, version of Python, what a run lacks, and what each extra lacks."""
    text = (ROOT / "tests" / "requirements.lock").read_text(encoding="utf-8")
    pins = dict(re.findall(r"^([\w.-]+)==([^\s;\\]+)", text, flags=re.MULTILINE))
    for platform in PLATFORMS:
        for python in PYTHONS:
            run = lacking(["-r", "requirements.lock"], platform, python)
            extras = {
                extra: lacking([f"{name}=={pins[name]}" for name in names], platform, python)
                for extra, names in EXTRAS.items()
            }
            yield platform, python, run, {extra: said for extra, said in extras.items() if said}


def main() -> None:
    """Print a line for each platform and version of Python."""
    if shutil.which("uv") is None:
        sys.exit("this needs uv: pip install uv")
    for platform, python, run, extras in answers():
        more = "; ".join(f"{extra}: {said}" for extra, said in extras.items()) or "all there"
        print(f"{platform}, Python {python}: a run {f'lacks {run}' if run else 'has all'}; extras: {more}", flush=True)


if __name__ == "__main__":
    main()
