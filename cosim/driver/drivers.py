"""Drivers at hand, by the config's name."""

from collections.abc import Mapping

from cosim.driver.cautious import Cautious
from cosim.driver.driver import Unaffected

DRIVERS: Mapping[str, type] = {"none": Unaffected, "cautious": Cautious}
"""Drivers at hand, by the config's name."""
