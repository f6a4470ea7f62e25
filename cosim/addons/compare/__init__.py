"""What cosim computes beside published and measured values: `cosim compare`.

Question: which of its figures agree with the world? For everybody who cites one. Tests: `tests/addons/compare`.
"""

from cosim.base.addons import Addon

ADDON = Addon(commands={"compare": "cosim.addons.compare.commands:compare"})
"""The command `cosim compare`."""
