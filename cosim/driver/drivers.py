"""The included drivers."""

from collections.abc import Mapping

from cosim.driver.cautious import Cautious
from cosim.driver.driver import Unaffected

DRIVERS: Mapping[str, type] = {"none": Unaffected, "cautious": Cautious}
"""Classes of the included drivers, by their name in the config."""
