"""The figures of the paper's tables for one run: average precision of its egos, and trust at the end.

An ego is an equipped vehicle that the config designates (`attacks.0.victim = "designated"`) and that is never an
attacker. Roles are drawn from names, so all settings of a replicate have the same egos.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from cosim.addons.perception.kitti import FEWEST, LEVELS, STRICT, average_precision
from cosim.addons.perception.kitti_frames import actors_ahead, boxes_ahead
from cosim.attacks.victims import designated
from cosim.runs import replay_lidar
from cosim.traffic.actors import actor_key
from results.metrics import trust
from results.run import Run

CLASSES = ("car", "pedestrian")
RANGE_M = 140.0
_COLUMNS = ["metric", "group", "value", "unit", "label"]


def measures(run: Run) -> pd.DataFrame:
    """Metrics of a run's trust variant, for `measure.own` of a study.

    Returns
    -------
    Columns metric, group, value, unit, label.
    """
    return pd.DataFrame([*_precision(run), *_trust(run)], columns=_COLUMNS)


def egos_of(run: Run) -> np.ndarray:
    """Actor numbers of a run's egos, ascending.

    Raises
    ------
    ValueError
        If the run's config designates no egos.
    """
    config = replay_lidar.config_of(run)
    if not config.attacks or config.attacks[0].victim != "designated":
        raise ValueError(f'{run.path} designates no egos. Set attacks.0.victim to "designated".')
    cars = run.vehicles[run.vehicles.equipped]
    keys = np.array([actor_key(name, False) for name in cars.sumo_id], np.uint64)
    is_honest = (cars.role == "honest").to_numpy(bool)
    chosen = designated(config.seed, keys, config.attacks[0].victim_p) & is_honest
    return np.sort(cars.vehicle.to_numpy()[chosen])


def _precision(run: Run) -> Iterator[tuple[str, str, float, str, str]]:
    """Average precision of the fused objects of all egos over all steps, and the number of objects that count."""
    egos = egos_of(run)
    steps = np.arange(int(run.manifest["steps"]))
    truth, poses = actors_ahead(run, steps, RANGE_M, egos)
    yield "paper.egos.n", "", float(poses.observer.nunique()), "", "egos"
    yield "paper.frames.n", "", float(len(poses)), "", "frames"
    if not len(poses):
        return
    found = boxes_ahead(run, "fused", steps, poses, RANGE_M)
    for label in CLASSES:
        if not (truth.label == label).any():
            continue
        answer = average_precision(truth, found, label, "3d", STRICT[label])
        for level in LEVELS:
            yield "paper.objects.n", f"{label}, {level}", float(answer[level].n_truth), "", "objects that count"
            if answer[level].n_truth >= FEWEST:
                group = f"{label}, {level}"
                yield "paper.ap11", group, answer[level].ap11, "%", "AP 3D, 11 recall points"
                yield "paper.ap40", group, answer[level].ap40, "%", "AP 3D, 40 recall points"


def _trust(run: Run) -> Iterator[tuple[str, str, float, str, str]]:
    """Mean of the last trust value of equipped vehicles without egos; a vehicle without a value has the default.

    Of a vehicle with several pseudonyms, the last value of its own identity counts.
    Attackers that never met an ego never attacked, and are left out. If no vehicle attacks in the run, they count.
    """
    is_ego = run.vehicles.vehicle.isin(egos_of(run))
    cars = run.vehicles[run.vehicles.equipped & ~is_ego]
    if cars.attack_start_step.notna().any():
        cars = cars[(cars.role == "honest") | cars.attack_start_step.notna()]
    values, is_own = trust.values(run), run.subjects.identity == 0
    values = values[values.subject.map(is_own)]
    last = values.drop_duplicates("vehicle", keep="last").set_index("vehicle").trust
    default = float(run.config["trust"]["default_trust"])
    value = cars.vehicle.map(last).astype(float).fillna(default)
    for role, some in value.groupby(cars.role.astype(str)):
        yield "paper.final_trust.mean", str(role), float(some.mean()), "1", "mean trust at the end"


def of_egos(run: Run, *, metric: str, groups: Sequence[str], variant: str = "base") -> list[float]:
    """One of the metrics of a trust variant, for some groups; NaN where the run holds too little."""
    table = measures(run.as_variant(variant))
    value = table[table.metric == metric].set_index("group").value
    return [float(value.get(group, np.nan)) for group in groups]
