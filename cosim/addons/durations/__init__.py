"""How long encounters and the times between them last: families of distributions fitted under censoring.

Question: which law do contact durations follow, here and in what others measured? For researchers in opportunistic
networks. Tests: `tests/addons/durations`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "figure": {"durations": "cosim.addons.durations.figure:draw"},
        "measure": {
            name: f"cosim.addons.durations.measures:{name}" for name in ("family_rank", "tail_shape", "median_duration")
        },
        "topic": {"durations": "cosim.addons.durations.metrics"},
    },
)
