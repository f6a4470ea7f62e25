"""What the name of a file says about its content."""

from pathlib import PurePath

COMMON_STEMS = frozenset(
    (
        "osm",
        "run",
        "sim",
        "simulation",
        "scenario",
        "sumo",
        "config",
        "configuration",
        "main",
        "test",
        "default",
        "net",
        "network",
        "map",
        "demo",
        "dua",
        "due",
        "static",
        "fcd",
        "trace",
        "cfg",
    )
)
"""File names that say nothing about the scenario."""


def name_of(path: PurePath) -> str:
    """Name of a scenario: the file's stem, or its folder's name if the stem is a common word."""
    folder, stem = path.parent.name, path.stem.removesuffix(".sumo")
    return folder if stem.lower() in COMMON_STEMS and folder else stem
