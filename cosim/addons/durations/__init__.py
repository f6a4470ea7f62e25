"""How long encounters and the times between them last: families of distributions fitted under censoring, and facts.

Question: which law do contact durations follow, here and in what others measured? For researchers in opportunistic
networks. Tests: `tests/addons/durations`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "judge": "cosim.addons.durations.commands:judges",
    },
    choices={
        "figure": {"durations": "cosim.addons.durations.figure:draw"},
        "topic": {"durations": "cosim.addons.durations.metrics"},
    },
)
