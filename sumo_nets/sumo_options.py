"""Options of SUMO 1.28 in a .sumocfg: which are passed on, which are ignored, which are refused.

SUMO never reads the user's configuration. It reads a copy that holds the options of `READS` and `PASSED` only.
`sumo_options.toml` has the options of SUMO's own schema. An option that the schema does not know is refused.
"""

import tomllib
from pathlib import Path

READS = (
    "net-file", "route-files", "additional-files", "weight-files", "load-state", "astar.all-distances",
    "astar.landmark-distances", "device.fcd-replay.files",
)  # fmt: skip
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

SYNONYMS = {
    "net": "net-file", "n": "net-file", "routes": "route-files", "r": "route-files", "additional": "additional-files",
    "a": "additional-files", "weights": "weight-files", "w": "weight-files", "measure": "weight-attribute",
    "x": "weight-attribute", "b": "begin", "e": "end", "srand": "seed", "abs-rand": "random", "ndump": "netstate-dump",
    "netstate": "netstate-dump", "netstate-output": "netstate-dump", "summary": "summary-output",
    "tripinfo": "tripinfo-output", "personinfo": "personinfo-output", "vehroutes": "vehroute-output",
    "personroutes": "personroute-output", "statistics-output": "statistic-output", "person-fcd": "person-fcd-output",
    "log-file": "log", "l": "log", "v": "verbose", "p": "print-options", "W": "no-warnings",
    "suppress-warnings": "no-warnings", "X": "xml-validation", "C": "save-configuration", "c": "configuration-file",
    "H": "human-readable-time", "g": "gui-settings-file", "S": "start", "Q": "quit-on-end", "G": "game", "d": "delay",
    "B": "breakpoints", "m": "edgedata-files", "N": "alternative-net-file", "D": "demo", "T": "disable-textures",
    "device.routing.period": "device.rerouting.period", "device.routing.pre-period": "device.rerouting.pre-period",
    "device.rerouting.knownveh": "device.rerouting.explicit", "device.emissions.knownveh": "device.emissions.explicit",
    "device.btreceiver.knownveh": "device.btreceiver.explicit", "device.btsender.knownveh": "device.btsender.explicit",
    "device.fcd.knownveh": "device.fcd.explicit", "carfollow.model": "default.carfollowmodel",
    "no-duration-log": "duration-log.disable",
}  # fmt: skip
"""Other names that SUMO accepts."""
