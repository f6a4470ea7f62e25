"""Trust models by name: one file per model, behind `interface.TrustModel`."""

from collections.abc import Mapping

from cosim.base.addons import Choices
from trust.models.beta import Beta
from trust.models.interface import ScoresObjects, TrustModel, params_of
from trust.models.trupercept import TruPercept

MODELS: Mapping[str, type[TrustModel]] = Choices("trust", {"trupercept": TruPercept, "beta": Beta})
"""Constructors by the value of `trust.model`."""

__all__ = ["MODELS", "ScoresObjects", "TrustModel", "params_of"]
