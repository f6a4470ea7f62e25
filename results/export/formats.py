"""What an exporter is, and those that ship."""

from collections.abc import Callable, Mapping
from typing import Protocol

from results.export.kitti import Kitti
from results.export.moments import Plan, Selection
from results.export.opv2v import Opv2v
from results.export.pcap import Pcap
from results.export.trupercept import TruPerceptData
from results.export.veremi import Veremi
from results.export.veremi_nextgen import VeremiNextGen


class Exporter(Protocol):
    """Writes a run in another tool's layout."""

    @property
    def TABLES(self) -> tuple[str, ...]:
        """Tables that the run must hold; a class attribute will do."""
        ...

    def plan(self, selection: Selection) -> Plan:
        """The files to write for some vehicles and steps of a run.

        Raises
        ------
        ValueError
            In one line, where these vehicles and steps will not do.
        """
        ...


EXPORTERS: Mapping[str, Callable[[], Exporter]] = {
    "kitti": Kitti, "trupercept": TruPerceptData, "opv2v": Opv2v, "veremi": Veremi, "veremi-nextgen": VeremiNextGen,
    "pcap": Pcap,
}  # fmt: skip
"""Exporters by name."""
