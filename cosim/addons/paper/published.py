"""Figures that the paper prints for its quantitative experiments [1]_.

References
----------
.. [1] Hurl, Cohen, Czarnecki, Waslander, "TruPercept", 2020: tables "Results: TruPercept" and "Results: Updated
   position/orientation", and section "Trust Levels".
"""

from collections.abc import Mapping

from results.metrics.kitti import LEVELS

METHODS: Mapping[str, str] = {
    "local": "AVOD",
    "trupercept_1": "TruPercept 1",
    "trupercept_2": "TruPercept 2",
    "trupercept_3": "TruPercept 3",
    "corrected": "Corrected",
}
"""Name in the paper's tables by `trust.method`."""

_AP = {
    "local": ((66.8, 62.8, 52.1, 36.3), (84.2, 78.7, 75.1, 57.3)),
    "trupercept_1": ((54.6, 48.9, 43.9, 31.5), (76.7, 68.7, 70.0, 54.0)),
    "trupercept_2": ((57.2, 51.4, 46.0, 32.8), (78.6, 70.4, 71.4, 55.0)),
    "trupercept_3": ((64.8, 62.1, 51.1, 36.7), (83.4, 78.8, 75.8, 58.5)),
    "corrected": ((69.5, 61.0, 54.1, 37.8), (89.0, 80.6, 80.1, 61.0)),
}

AP: Mapping[tuple[str, str, str], float] = {
    (method, label, level): value
    for method, classes in _AP.items()
    for label, values in zip(("car", "pedestrian"), classes, strict=True)
    for level, value in zip(LEVELS, values, strict=True)
}
"""Average precision [%] by method, class and level, for honest vehicles. The paper prints no other setting."""

FINAL_TRUST: Mapping[str, float] = {"trustworthy": 0.27, "unreliable": 0.25, "malicious": 0.13}
"""Mean trust at the end of the experiments."""
