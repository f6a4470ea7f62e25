"""Notes on what looks like a mistake in a study, before its runs are made. Each note is one line."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scipy.stats import t

from cosim.config.config import Config
from cosim.runs import check as checking
from cosim.studies.density import equipped_on_road, scenario_of
from cosim.studies.points import Point
from cosim.studies.study import SHIPPED, Study, load
from cosim.traffic.scene_summary import scene_summary


def keys_in_vain(points: Sequence[Point]) -> list[str]:
    """Notes on keys that change nothing, with the number of points if this is so in some of them only."""
    found: Counter[str] = Counter()
    for point in points:
        traffic = point.config.traffic
        found.update(checking.keys_in_vain(point.config, scenario_of(traffic.scenario, traffic.trace)))
    notes = []
    for note, n in found.items():
        if n != len(points):
            note = f"{note[:-1]}, in {n} of {len(points)} points."
        notes.append(note)
    return notes


def scene_notes(points: Sequence[Point]) -> list[str]:
    """Notes on the streets and buildings of the scenarios of a study, each scenario once."""
    notes: list[str] = []
    config_of: dict[tuple[str, str | None], Config] = {}
    for point in points:
        traffic = point.config.traffic
        config_of.setdefault((traffic.scenario, traffic.trace), point.config)
    for (name, trace), config in config_of.items():
        scenario = scenario_of(name, trace)
        scene = scene_summary(scenario)
        notes += scene.notes
        if scene.n_buildings == 0:
            notes.append(
                f"note: {trace or name} has no buildings to block lines of sight. `cosim nets build` makes a "
                "city with buildings of a map."
            )
        notes += checking.empty_streets(config, scenario)
    return notes


FEW_EQUIPPED = 5.0
"""Fewer equipped vehicles than this on the road at a time hardly meet, and a share of them is one vehicle or none."""


def fleet_notes(points: Sequence[Point]) -> list[str]:
    """A note on the points with hardly any equipped vehicles."""
    found = {}
    for point in points:
        config = point.config
        named = (replace(config.traffic, seed=0), config.fleet)  # replicates are alike
        if named not in found and config.sensing:
            found[named] = equipped_on_road(config)
    few = {named: n for named, n in found.items() if n < FEW_EQUIPPED}
    if not few:
        return []
    (traffic, fleet), n = min(few.items(), key=lambda of: of[1])
    more = f", and {len(few) - 1} more" if len(few) > 1 else ""
    return [
        f"note: about {n:.1f} equipped vehicles are on the road at a time at traffic.scenario = {traffic.scenario}, "
        f"traffic.scale = {traffic.scale:g} and fleet.penetration_p = {fleet.penetration_p:g}{more}. So few hardly "
        "meet, and a share of them is one vehicle or none. Raise fleet.penetration_p or traffic.scale."
    ]


FEW_REPLICATES = 5
"""Fewer replicates than this give intervals that are wider than 1.5 standard deviations to either side."""


def interval_notes(study: Study) -> list[str]:
    """What intervals over so few replicates cannot say, before they are made."""
    n = study.head.replicates
    if n >= FEW_REPLICATES:
        return []
    if n == 1:
        return [
            "note: study.replicates = 1: means will have no interval, and no difference can be told from chance. Set 5."
        ]
    return [
        f"note: study.replicates = {n}: a 95 % interval reaches {_half_interval(n):.1f} standard deviations of a "
        f"replicate to either side ({FEW_REPLICATES} replicates: {_half_interval(FEW_REPLICATES):.1f}). A smaller "
        "paired difference cannot be told from chance."
    ]


def _half_interval(n: int) -> float:
    """Half of a 95 % interval of the mean of n replicates, in standard deviations of a replicate."""
    return float(t.ppf(0.975, n - 1)) / n**0.5


def name_notes(path: Path, study: Study) -> list[str]:
    """A note on a changed copy of a shipped study that kept its name and its question."""
    shipped = SHIPPED / f"{study.head.name}.toml"
    if not (path.is_file() and shipped.is_file()):
        return []
    original = load(shipped)
    if study.head.question != original.head.question or study.to_toml() == original.to_toml():
        return []
    return [
        f'note: study.name = "{study.head.name}" is that of a shipped study, which {path} changes. Its report will '
        "have this name and this question: write your own."
    ]
