"""Trust as a classifier of vehicles: precision, recall, false exclusions, the time until a liar is revoked.

Question: what does excluding vehicles by their trust cost, and whom does it hit? For researchers who compare trust
models as detectors. Tests: `tests/addons/security`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "figure": {"security": "cosim.addons.security.figure:draw"},
        "topic": {"security": "cosim.addons.security.security"},
    },
)
