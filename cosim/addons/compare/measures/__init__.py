"""Ways of measuring: functions of the runs behind a fact and its options, by name."""

from collections.abc import Callable, Mapping, Sequence

from cosim.addons.compare.facts import Measured
from cosim.addons.compare.measures import cooperation, detection, early_fusion, encounters, messages, radio, traffic
from results.run import Run

Measure = Callable[..., Measured]
"""Takes the runs (an empty list if the fact needs none) and the options of the fact by keyword."""

MEASURES: Mapping[str, Callable[..., Measured]] = {
    "cpm_object_bytes": messages.cpm_object_bytes,
    "frame_airtime": radio.frame_airtime,
    "path_loss": radio.path_loss,
    "blockage": radio.blockage,
    "delivery_of_one_sender": radio.delivery_of_one_sender,
    "reception_around_corner": radio.reception_around_corner,
    "range_around_corner": radio.range_around_corner,
    "sight_past_buildings": radio.sight_past_buildings,
    "sight_past_everything": radio.sight_past_everything,
    "actor_size": traffic.actor_size,
    "walking_speed": traffic.walking_speed,
    "braking_to_a_stop": traffic.braking_to_a_stop,
    "braking_limit": traffic.braking_limit,
    "sudden_slowing": traffic.sudden_slowing,
    "mild_braking": traffic.mild_braking,
    "mean_speed": traffic.mean_speed,
    "steady_headway": traffic.steady_headway,
    "overlapping": traffic.overlapping,
    "position_error": traffic.position_error,
    "relative_speed_law": encounters.relative_speed_law,
    "link_duration_law": encounters.link_duration_law,
    "gap_law": encounters.gap_law,
    "precision_by_level": detection.precision_by_level,
    "precision_by_range": detection.precision_by_range,
    "recall_by_overlap": detection.recall_by_overlap,
    "boxes_per_frame": detection.boxes_per_frame,
    "position_error_of_boxes": detection.position_error_of_boxes,
    "recall_when_near": detection.recall_when_near,
    "share_with_returns": detection.share_with_returns,
    "late_gain": cooperation.late_gain,
    "late_gain_at_speed": cooperation.late_gain_at_speed,
    "change_of_late": cooperation.change_of_late,
    "precision_of_early": cooperation.precision_of_early,
    "early_gain": cooperation.early_gain,
    "early_over_late": cooperation.early_over_late,
    "change_of_early": cooperation.change_of_early,
    "cloud_bytes": early_fusion.cloud_bytes,
    "cloud_airtime": early_fusion.cloud_airtime,
}


def measured(name: str, runs: Sequence[Run], options: Mapping[str, object]) -> Measured:
    """What a way of measuring finds.

    Raises
    ------
    ValueError
        If the runs hold too little, in one line.
    """
    return MEASURES[name](runs, **options)
