"""Options of SUMO 1.28 in a .sumocfg: which are passed on, which are ignored, which are refused.

SUMO never reads the user's configuration. It reads a copy that holds the options of `READS` and `PASSED` only.
`sumo_options.toml` has the options of SUMO's own schema, and their other names. An option that the schema does not know
is refused.
"""

import tomllib
from pathlib import Path

READS = (
    "net-file",
    "route-files",
    "additional-files",
    "weight-files",
    "load-state",
    "astar.all-distances",
    "astar.landmark-distances",
    "device.fcd-replay.files",
)
"""Options that name files to read."""

REFUSED = {
    "configuration-file": "names another configuration",
    "save-configuration": "writes a file and ends",
    "save-configuration.relative": "goes with save-configuration",
    "save-template": "writes a file and ends",
    "save-schema": "writes a file and ends",
    "save-commented": "goes with save-template",
    "help": "prints a text and ends",
    "version": "prints a text and ends",
}
"""Options with which SUMO does something else than to simulate, and what."""

_OPTIONS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))

PASSED, IGNORED = frozenset(_OPTIONS["passed"]), frozenset(_OPTIONS["ignored"])
"""Options that change the traffic only. Options that write files, open ports, belong to the graphical interface or to
messages, or are set by the run."""

SYNONYMS = {other: name for name, others in _OPTIONS["synonyms"].items() for other in others}
"""Options by other names that SUMO accepts."""
