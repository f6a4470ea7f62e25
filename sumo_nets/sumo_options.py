"""Options of SUMO 1.28 in a .sumocfg: which are passed on, which are ignored, which are refused.

SUMO never reads the user's configuration. It reads a copy that holds the options of `READS` and `PASSED` only. Topics
and types of the options come from SUMO's own schema. An option that the schema does not know is refused.
"""

import re
from pathlib import Path

import sumo

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

_IGNORED_TOPICS = ("output", "report", "traci_server", "gui_only")
_SET_BY_THE_RUN = frozenset(("seed", "random", "threads", "device.rerouting.threads"))
_SCHEMA = Path(sumo.SUMO_HOME) / "data" / "xsd" / "types" / "sumoConfigurationType.xsd"


def _passed_and_ignored() -> tuple[frozenset[str], frozenset[str]]:
    """The other options of the schema: those that change the traffic only, and the rest."""
    passed: set[str] = set()
    ignored: set[str] = set()
    for topic in re.split(r'<xsd:complexType name="sumo(?=\w+TopicType")', _SCHEMA.read_text(encoding="utf-8"))[1:]:
        for name, kind in re.findall(r'<xsd:element name="([^"]+)" type="(\w+)OptionType"', topic):
            names_a_file = kind == "file" or name.endswith(".file")
            is_ignored = names_a_file or name in _SET_BY_THE_RUN or topic.startswith(_IGNORED_TOPICS)
            (ignored if is_ignored else passed).add(name)
    return frozenset(passed.difference(READS, REFUSED)), frozenset(ignored.difference(READS, REFUSED))


PASSED, IGNORED = _passed_and_ignored()
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
