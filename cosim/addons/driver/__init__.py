"""Drivers that react to the objects that their vehicle believes in, and what that costs in safety.

Question: what do lies and trust cost in braking, time and collisions? For researchers of safety. The interface is in
`cosim.traffic.driver`. Tests: `tests/addons/driver`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "driver": {
            "cautious": "cosim.addons.driver.cautious:Cautious",
        },
        "figure": {"safety": "cosim.addons.driver.figure:draw"},
        "measure": {
            name: f"cosim.addons.driver.measures:{name}"
            for name in (
                "braking_to_a_stop",
                "braking_limit",
                "sudden_slowing",
                "mild_braking",
                "mean_speed",
                "steady_headway",
                "overlapping",
                "cam_interval",
                "cam_interval_shares",
            )
        },
        "topic": {"safety": "cosim.addons.driver.safety"},
    },
)
