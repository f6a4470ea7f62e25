"""The included drivers."""

from collections.abc import Mapping

from cosim.addons.driver.cautious import Cautious
from cosim.traffic.driver import Unaffected

DRIVERS: Mapping[str, type] = {"none": Unaffected, "cautious": Cautious}
"""Classes of the included drivers, by their name in the config."""
