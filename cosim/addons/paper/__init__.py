"""Reproduction of the TruPercept paper: its scenarios and experiments, with its results beside the obtained ones.

Question: does this program find what the paper found? For readers of the paper. Tests: `tests/addons/paper`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "reproduce": "cosim.addons.paper.commands:reproduce",
    },
)
