"""Predictions of what a study would measure, from traffic alone: no sweep is cast, no message sent, no trust computed.

Question: how old will trust be at lookup, and where should roadside units stand? For researchers who plan a study.
Tests: `tests/addons/law`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "predict": "cosim.addons.law.commands:predict",
        "place": "cosim.addons.law.place_commands:place",
    },
)
