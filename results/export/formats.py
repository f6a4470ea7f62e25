"""The layouts that a run can be exported to."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType

from results.export import kitti, opv2v, trupercept, veremi, veremi_nextgen
from results.export.moments import Plan, Selection


@dataclass(frozen=True, slots=True)
class Format:
    """A layout."""

    tables: tuple[str, ...]
    """Tables that the run must hold."""
    plan: Callable[[Selection], Plan]
    """What to write; ValueError in one line where these vehicles and steps do not do."""

    @staticmethod
    def of(module: ModuleType) -> "Format":
        """The layout of a file beside this one."""
        return Format(module.TABLES, module.plan)


FORMATS: Mapping[str, Format] = {
    "kitti": Format.of(kitti), "trupercept": Format.of(trupercept), "opv2v": Format.of(opv2v),
    "veremi": Format.of(veremi), "veremi-nextgen": Format.of(veremi_nextgen),
}  # fmt: skip
