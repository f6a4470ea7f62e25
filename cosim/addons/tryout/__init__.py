"""Trying a user's own class on a tiny scene, and the laws of its interface: `cosim new` and `cosim try`.

Question: does my class keep the rules before a long run? For authors of extensions. Tests: `tests/addons/tryout`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "new": "cosim.addons.tryout.commands:new",
        "try": "cosim.addons.tryout.commands:try_",
    },
)
