"""A run in the layouts that other tools read, and in the Rerun viewer, after a run or while it computes.

Question: how do I use the data in my own tools? For everybody. Frames are converted here and nowhere else. Tests:
`tests/addons/export`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    commands={
        "export": "cosim.addons.export.commands:export",
        "view": "cosim.addons.export.commands:view",
    },
    choices={
        "exporter": {
            "kitti": "cosim.addons.export.kitti:Kitti",
            "trupercept": "cosim.addons.export.trupercept:TruPerceptData",
            "opv2v": "cosim.addons.export.opv2v:Opv2v",
            "veremi-nextgen": "cosim.addons.export.veremi_nextgen:VeremiNextGen",
            "pcap": "cosim.addons.export.pcap:Pcap",
            "mcap": "cosim.addons.export.ros2:Ros2Bag",
            "nuscenes": "cosim.addons.export.nuscenes:NuScenes",
            "fcd": "cosim.addons.export.fcd:Fcd",
            "reports": "cosim.addons.export.reports:MisbehaviourReports",
        },
    },
    hooks={
        "export": "cosim.addons.export.export:export",
        "live": "cosim.addons.export.live:Live",
    },
)
