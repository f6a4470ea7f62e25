"""Drivers that react to the objects that their vehicle believes in.

Question: what do lies and trust cost in braking, time and collisions? For researchers of safety. The interface is in
`cosim.traffic.driver`. Tests: `tests/addons/driver`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "driver": {
            "cautious": "cosim.addons.driver.cautious:Cautious",
        },
    },
)
