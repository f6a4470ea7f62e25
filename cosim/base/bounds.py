"""Ranges of numbers that parameters of many sections have. A name says the largest number, and whether 0 is allowed."""

from typing import Annotated

from annotated_types import Ge, Gt, Le

Share = Annotated[float, Ge(0), Le(1)]
"""A probability, or a part of a whole."""
PositiveShare = Annotated[float, Gt(0), Le(1)]
Positive100 = Annotated[float, Gt(0), Le(100)]
NotNegative100 = Annotated[float, Ge(0), Le(100)]
Positive1000 = Annotated[float, Gt(0), Le(1000)]
NotNegative1000 = Annotated[float, Ge(0), Le(1000)]
