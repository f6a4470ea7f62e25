"""What an exporter is, and those that ship."""

from collections.abc import Callable, Mapping
from typing import Protocol

from cosim.addons.export.fcd import Fcd
from cosim.addons.export.kitti import Kitti
from cosim.addons.export.nuscenes import NuScenes
from cosim.addons.export.opv2v import Opv2v
from cosim.addons.export.pcap import Pcap
from cosim.addons.export.reports import MisbehaviourReports
from cosim.addons.export.ros2 import Ros2Bag
from cosim.addons.export.trupercept import TruPerceptData
from cosim.addons.export.veremi_nextgen import VeremiNextGen
from results.moments import Plan, Selection


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
    "kitti": Kitti, "trupercept": TruPerceptData, "opv2v": Opv2v, "veremi-nextgen": VeremiNextGen, "pcap": Pcap,
    "mcap": Ros2Bag, "nuscenes": NuScenes, "fcd": Fcd, "reports": MisbehaviourReports,
}  # fmt: skip
"""Exporters by name."""
