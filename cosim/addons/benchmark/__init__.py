"""The benchmark of trust models: recorded evidence, a score of any model on it, and an adversary that adapts.

Question: how good is my trust model, beside all models that ship? For authors of trust models. Tests:
`tests/addons/benchmark`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "benchmark": "cosim.addons.benchmark.commands:benchmark",
    },
)
