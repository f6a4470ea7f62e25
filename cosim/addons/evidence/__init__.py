"""Audit of the evidence behind trust: how right evaluations are, how often one look counts,
and what could be known at best.

Question: does a trust model fail, or the evidence that it gets? For authors of trust models. Tests:
`tests/addons/evidence`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "topic": {
            "evidence": "cosim.addons.evidence.multiplicity",
            "evaluations": "cosim.addons.evidence.evaluations",
        },
    },
)
