"""Ways of measuring: functions of a run and of the options of a fact, by name. Add-ons may bring further ones.

A measure returns the values of its fact in a run; one that needs no run may also return a row per replicate.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cosim.addons.compare import scenarios
from cosim.addons.compare.facts import Measured
from cosim.addons.compare.measures import encounters, radio, traffic
from cosim.base.addons import Choices
from results.run import Run

Measure = Callable[..., Any]

_MODULES = (encounters, radio, scenarios, traffic)

MEASURES: Mapping[str, Measure] = Choices(
    "measure", {name: getattr(module, name) for module in _MODULES for name in module.MEASURES}
)


def measured(name: str, runs: Sequence[Sequence[Run]], options: Mapping[str, object]) -> Measured:
    """What a way of measuring finds.

    Parameters
    ----------
    name
        Name of the measure.
    runs
        The replicates of each plan; empty if the measure needs no run.
    options
        Further arguments of the measure.

    Raises
    ------
    ValueError
        If the runs hold too little, in one line.
    """
    measure = MEASURES[name]
    if not runs:
        return Measured.of(measure(**options))
    found = [measure(*of_one_replicate, **options) for of_one_replicate in zip(*runs, strict=True)]
    return Measured.of(np.array(found))
