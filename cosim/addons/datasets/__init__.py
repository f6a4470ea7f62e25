"""Recorded data sets in their published layouts, through our matching, fusion and trust: `cosim evaluate`.

Question: does matching and fusion do on real roads what it does here? For researchers in perception. Tests:
`tests/addons/datasets`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "evaluate": "cosim.addons.datasets.commands:evaluate",
    },
)
