"""Positions from elsewhere: logs, drone recordings and outputs of other simulators become traffic or contacts.

Question: how long do the vehicles of my trace meet? For researchers with traces of their own. Tests:
`tests/addons/traces`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "contacts": "cosim.addons.traces.commands:contacts",
        "trace": "cosim.addons.traces.trace_commands:trace",
    },
)
