"""Sidelink of NR-V2X (mode 2) and LTE-V2X (mode 4): stations choose their own resources by sensing.

Question: what would trust and encounters be with the other radio of the standards? For researchers in V2X. The keys are
in `cosim.radio.sidelink_params`. Tests: `tests/addons/sidelink`, `tests/cosim/radio`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "medium": {
            "nr_mode2": "cosim.addons.sidelink.medium:nr_mode2",
            "lte_mode4": "cosim.addons.sidelink.medium:lte_mode4",
        },
    },
)
