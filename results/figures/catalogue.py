"""All pictures by name."""

from collections.abc import Callable, Mapping

from matplotlib.figure import Figure

from cosim.base.addons import Choices
from results.figures import (
    ages,
    encounters,
    freshness,
    misbehaviour,
    radio,
    trust,
)

FIGURES: Mapping[str, Callable[..., Figure]] = Choices(
    "figure",
    {
        "trust": trust.draw,
        "misbehaviour": misbehaviour.draw,
        "encounters": encounters.draw,
        "freshness": freshness.draw,
        "radio": radio.draw,
        "ages": ages.draw,
    },
)
