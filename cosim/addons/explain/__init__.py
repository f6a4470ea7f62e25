"""What a word means, and what to cite: `cosim explain` and `cosim cite`; the dictionary of tables and metrics.

Question: what is this key, metric, column, model or term, and who published it? For newcomers and authors. Tests:
`tests/addons/explain`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "explain": "cosim.addons.explain.commands:explain",
        "cite": "cosim.addons.explain.commands:cite",
    },
)
