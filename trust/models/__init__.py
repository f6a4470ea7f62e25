"""Trust models by name: one file per model, behind `interface.TrustModel`."""

from trust.models.beta import Beta
from trust.models.interface import TrustModel, params_of
from trust.models.trupercept import TruPercept

MODELS: dict[str, type[TrustModel]] = {"trupercept": TruPercept, "beta": Beta}
"""Constructors by the value of `trust.model`."""

__all__ = ["MODELS", "TrustModel", "params_of"]
