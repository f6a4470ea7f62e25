"""How good perception is: average precision by the rules of KITTI and OpenCOOD, of runs and of recorded data sets.

Question: what do sensors and fusion see, here and on real roads? For researchers in perception. `cosim evaluate` takes
data sets in their published layouts through our matching, fusion and trust. Tests: `tests/addons/perception`.
"""

from cosim.base.addons import Addon

_MEASURES = {
    "cooperation": ("precision_gain", "late_gain_at_speed"),
    "early_fusion": ("cloud_bytes",),
    "precision": (
        "precision_by_level",
        "precision_by_range",
        "recall_by_overlap",
        "share_with_returns",
        "boxes_per_frame",
        "position_error_of_boxes",
    ),
    "ego_metrics": ("of_egos",),
}
"""Measures of facts by the module that has them."""

ADDON = Addon(
    commands={
        "evaluate": "cosim.addons.perception.commands:evaluate",
    },
    choices={
        "figure": {"detection": "cosim.addons.perception.figure:draw"},
        "measure": {
            name: f"cosim.addons.perception.measures.{module}:{name}"
            for module, names in _MEASURES.items()
            for name in names
        },
        "topic": {"detection": "cosim.addons.perception.detection"},
    },
)
