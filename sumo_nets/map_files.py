"""Files of OpenStreetMap that are given where a city is wanted."""

import shlex
from pathlib import Path

SUFFIXES = (".osm", ".osm.gz", ".osm.xml.gz", ".osm.pbf")
"""File name endings of maps."""


def refuse_map(path: Path, key: str) -> None:
    """Raise ValueError, which names the right commands, if a file is a map. `key` begins the message."""
    if path.name.endswith(SUFFIXES):
        stem = path.name.partition(".")[0]
        given, out = shlex.quote(str(path)), shlex.quote(stem)
        raise ValueError(
            f"{key}{path} is a map of OpenStreetMap, not a city. Build a city from it, then run that: cosim nets build "
            f"--osm {given} --out {out}, cosim run --set traffic.scenario={out}"
        )
