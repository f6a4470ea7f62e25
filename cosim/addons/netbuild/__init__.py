"""Building of cities: networks, buildings and demand from OpenStreetMap, demand from counts, tiled cities.

Question: how do I simulate my own city? For everybody whose city does not ship. Tests: `tests/addons/netbuild`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "nets build": "cosim.addons.netbuild.commands:build",
        "nets counts": "cosim.addons.netbuild.commands:counts",
        "nets tile": "cosim.addons.netbuild.commands:tile",
    },
    hooks={"package_city": "cosim.addons.netbuild.build_from_sumo_package:folder_of"},
)
