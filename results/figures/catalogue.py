"""All pictures by name."""

from collections.abc import Callable, Mapping

from matplotlib.figure import Figure

from cosim.base.addons import Choices
from results.figures import (
    ages,
    attacks,
    contacts,
    delays,
    delivery,
    detection,
    encounters,
    exclusion,
    freshness,
    map,
    misbehaviour,
    radio,
    security,
    stale,
    trust,
)

FIGURES: Mapping[str, Callable[..., Figure]] = Choices(
    "figure",
    {
        "trust": trust.draw,
        "misbehaviour": misbehaviour.draw,
        "security": security.draw,
        "attacks": attacks.draw,
        "delays": delays.draw,
        "encounters": encounters.draw,
        "freshness": freshness.draw,
        "radio": radio.draw,
        "detection": detection.draw,
        "map": map.draw,
        "contacts": contacts.draw,
        "delivery": delivery.draw,
        "ages": ages.draw,
        "exclusion": exclusion.draw,
        "stale": stale.draw,
    },
)
