"""All pictures by name."""

from collections.abc import Callable, Mapping

from matplotlib.figure import Figure

from cosim.base.addons import Choices
from results.figures import (
    ages,
    encounters,
    freshness,
    map,
    misbehaviour,
    radio,
    stale,
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
        "map": map.draw,
        "ages": ages.draw,
        "stale": stale.draw,
    },
)
