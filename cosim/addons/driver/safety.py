"""What drivers suffer: braking, conflicts, collisions, stops and time, per vehicle-kilometre; and why they brake."""

import numpy as np
import pandas as pd

from cosim.addons.driver.conflicts import begins, driven_km, encroachments, following, held, overlaps, tracks
from cosim.base.codes import OBJECT, PARKED
from cosim.base.ragged import differs_from_last, expand, rows_of
from results.run import Run

HARD_MPS2, EMERGENCY_MPS2, RESET_MPS2 = 3.0, 4.5, 1.0
"""Braking events begin at the first two decelerations, and end below the third."""
TTC_S, DRAC_MPS2, PET_S = 3.0, 3.0, 2.0
"""Thresholds of conflicts, those of SUMO's SSM device."""
NEAR_MISS_S = 1.0
"""Time to collision or post-encroachment time below which a conflict is a near miss."""
WAVE_MPS2, WAVE_S = 2.0, 20.0
"""A driver is part of a braking wave who brakes this hard behind another one, within this time of its beginning."""
SLOW_MPS, MOVING_MPS = 0.1, 2.0
"""A vehicle stops that is slower than the first and was faster than the second."""
_ACTORS = 1 << 32
"""More than there are vehicles: a number of two, the second a vehicle."""
KINDS = ("ghost", "false positive", "real")
"""What a vehicle reacts to: fabricated by an attack, a detector's false positive, an actor."""


def braking(run: Run, poses: pd.DataFrame | None = None) -> pd.DataFrame:
    """Braking events: actor, step, severity ("hard" from 3 m/s2, "emergency" from 4.5); an emergency is hard too.

    Notes
    -----
    An event ends once the deceleration is below 1 m/s2. Limits are met within the resolution of recorded speeds.
    """
    poses = _by_actor(tracks(run) if poses is None else poses)
    rounding = 1 / 256 / run.dt_s
    found = []
    for severity, limit in (("hard", HARD_MPS2), ("emergency", EMERGENCY_MPS2)):
        down = -poses.acceleration_mps2.fillna(0.0).to_numpy()
        rows = begins(down >= limit - rounding, down < RESET_MPS2, poses.actor.to_numpy())
        found.append(poses.loc[rows, ["actor", "step"]].assign(severity=severity))
    return pd.concat(found, ignore_index=True)


def stops(run: Run, poses: pd.DataFrame | None = None) -> pd.DataFrame:
    """Stops: actor, step."""
    poses = _by_actor(tracks(run) if poses is None else poses)
    speed, actor = poses.speed_mps.to_numpy(), poses.actor.to_numpy()
    is_first = differs_from_last(actor)
    stands = (speed < SLOW_MPS) | is_first
    now = held(np.where(speed > MOVING_MPS, 1, np.where(stands, -1, 0)))
    before = np.append(-1, now[:-1])
    stopped = (now == -1) & (before == 1) & ~is_first
    return poses.loc[stopped, ["actor", "step"]].reset_index(drop=True)


def conflicts(run: Run, poses: pd.DataFrame | None = None) -> pd.DataFrame:
    """Conflicts of vehicles with their leaders, in episodes of one pair.

    Steps in which either measure is beyond its threshold belong to one episode if they are at most 1 s apart.

    Returns
    -------
    actor, leader, step (first of the episode), ttc_s (least), drac_mps2 (largest).
    """
    pairs = following(run, poses)
    pairs = pairs[(pairs.ttc_s < TTC_S) | (pairs.drac_mps2 > DRAC_MPS2)]
    pairs = pairs.sort_values(["actor", "leader", "step"])
    is_other_pair = (pairs[["actor", "leader"]].diff() != 0).any(axis=1)
    is_later = pairs.step.diff() * run.dt_s > 1.0
    episodes = pairs.groupby((is_other_pair | is_later).cumsum())
    how = {"actor": "first", "leader": "first", "step": "first", "ttc_s": "min", "drac_mps2": "max"}
    return episodes.agg(how).reset_index(drop=True)


def reactions(run: Run) -> pd.DataFrame:
    """Reactions of drivers to what their vehicles believe, in episodes.

    Reactions of one vehicle to one kind of object belong to one episode if they are at most 1 s apart.

    Returns
    -------
    vehicle, step, end_step, kind (one of `KINDS`), gap_m at the beginning, deceleration_mps2 (largest), taken_mps
    (speed taken by commands, summed).
    """
    run.require("reactions")
    rows = run.table("reactions")
    kind = np.where(rows.fabricated, "ghost", np.where(rows.truth_actor.notna(), "real", "false positive"))
    rows = rows.assign(kind=kind, taken_mps=rows.deceleration_mps2.clip(lower=0) * run.dt_s)
    rows = rows.sort_values(["vehicle", "kind", "step"])
    is_other = (rows.vehicle.diff() != 0) | (rows.kind != rows.kind.shift())
    is_later = rows.step.diff() * run.dt_s > 1.0
    return (
        rows.groupby((is_other | is_later).cumsum())
        .agg(
            vehicle=("vehicle", "first"),
            step=("step", "first"),
            end_step=("step", "last"),
            kind=("kind", "first"),
            gap_m=("gap_m", "first"),
            deceleration_mps2=("deceleration_mps2", "max"),
            taken_mps=("taken_mps", "sum"),
        )
        .sort_values(["vehicle", "step"], ignore_index=True)
    )


def waves(run: Run, poses: pd.DataFrame | None = None) -> pd.DataFrame:
    """Braking waves behind reactions of at least 2 m/s2.

    Returns
    -------
    vehicle, step and kind of the reaction; n_vehicles that braked behind it, each behind another one of the wave;
    length_m, the largest distance from the vehicle that reacted to one that joins the wave.
    """
    poses = tracks(run) if poses is None else poses
    causes = reactions(run)
    causes = causes[causes.deceleration_mps2 >= WAVE_MPS2]
    if causes.empty:
        return causes[["vehicle", "step", "kind"]].assign(n_vehicles=0, length_m=0.0)
    steps = poses[["step", "actor", "x_m", "y_m", "acceleration_mps2"]]
    chain = following(run, poses).merge(steps, on=["step", "actor"])
    chain = chain[chain.acceleration_mps2 <= -WAVE_MPS2].sort_values("step", kind="stable")
    causes = causes.sort_values("step", kind="stable")
    at = {name: chain[name].to_numpy(np.int64) for name in ("step", "actor", "leader")}
    place_m = chain[["x_m", "y_m"]].to_numpy()
    keys = steps.step.astype(np.int64) * _ACTORS + steps.actor
    steps = steps.assign(key=keys).sort_values("key")
    key, xy_m = steps.key.to_numpy(), steps[["x_m", "y_m"]].to_numpy()
    vehicle, first = causes.vehicle.to_numpy(np.int64), causes.step.to_numpy()
    n = np.zeros(len(first), int)
    length_m = np.zeros(len(first))
    wave, member = np.zeros(0, int), np.zeros(0, np.int64)  # who takes part in which wave, by member
    lasts = int(WAVE_S / run.dt_s)
    for step in np.unique(at["step"]).tolist():
        begun, over = np.searchsorted(first, [step, step - lasts], "right")
        fresh = np.setdiff1d(np.arange(over, begun), wave)
        wave = np.append(wave, fresh)
        member = np.append(member, vehicle[fresh])
        order = np.argsort(member, kind="stable")
        order = order[wave[order] >= over]
        wave, member = wave[order], member[order]
        rows = slice(*np.searchsorted(at["step"], [step, step + 1]))
        leader = at["leader"][rows]
        place, row = expand(np.searchsorted(member, leader), np.searchsorted(member, leader, "right"))
        behind = wave[place]
        actor = at["actor"][rows][row]
        new = ~np.isin(behind * _ACTORS + actor, wave * _ACTORS + member)
        row, behind, actor = row[new], behind[new], actor[new]
        wave, member = np.append(wave, behind), np.append(member, actor)
        np.add.at(n, behind, 1)
        head, is_there = rows_of(step * _ACTORS + vehicle[behind], key)
        apart_m = xy_m[head] - place_m[rows][row]
        away_m = np.hypot(*apart_m.T)
        np.maximum.at(length_m, behind[is_there], away_m[is_there])
    return causes[["vehicle", "step", "kind"]].assign(n_vehicles=n, length_m=length_m).sort_index()


def summary(run: Run) -> pd.Series:
    """Values of the metrics `safety.*` that have no group, by name: counts per vehicle-kilometre, distance and time."""
    poses = tracks(run)
    km = driven_km(poses, run)
    events = braking(run, poses).severity.value_counts()
    pairs, crossing = conflicts(run, poses), encroachments(run, poses)
    near = (pairs.ttc_s < NEAR_MISS_S).sum() + (crossing.pet_s < NEAR_MISS_S).sum()
    counts = {
        "hard_braking": events.get("hard", 0),
        "emergency_braking": events.get("emergency", 0),
        "ttc": (pairs.ttc_s < TTC_S).sum(),
        "drac": (pairs.drac_mps2 > DRAC_MPS2).sum(),
        "pet": (crossing.pet_s < PET_S).sum(),
        "near_misses": near,
        "stops": len(stops(run, poses)),
    }
    found = {"driven_km": km, "collisions.n": float(len(overlaps(run, poses)))}
    if km > 0:
        found["travel_time.s_per_km"] = _driving_s(run) / km
        found |= {f"{name}.per_km": n / km for name, n in counts.items()}
    return pd.Series(found)


def _driving_s(run: Run) -> float:
    """Vehicle-seconds on the road, without what stands there by the config: parked cars, `[[objects]]`, units."""
    query = """
        SELECT coalesce(sum(n_steps), 0) AS n FROM vehicles
        WHERE vehicle_class NOT IN ('pedestrian', 'roadside_unit')
            AND NOT starts_with(sumo_id, $parked) AND NOT starts_with(sumo_id, $object)
    """
    return float(run.sql(query, parked=PARKED, object=OBJECT).n.item()) * run.dt_s


def by_kind(run: Run) -> pd.DataFrame:
    """Reactions by what they are to. Those to ghosts and to false positives are false alarms.

    Returns
    -------
    kind, n, per_km, hard_per_km (reactions with 3 m/s2 or more), taken_mean_mps, and wave_mean_n and wave_mean_m (of
    reactions with 2 m/s2 or more). No rows if the run has no driver that could react.
    """
    if run.config.get("driver", {}).get("model", "none") == "none":
        return pd.DataFrame(columns=["kind", "n", "per_km"])
    poses = tracks(run)
    km = driven_km(poses, run)
    episodes, behind = reactions(run), waves(run, poses)
    rows = []
    for kind in KINDS:
        own = episodes[episodes.kind == kind]
        wave = behind[behind.kind == kind]
        hard = (own.deceleration_mps2 >= HARD_MPS2).sum()
        rows.append(
            {
                "kind": kind,
                "n": len(own),
                "per_km": len(own) / km if km else np.nan,
                "hard_per_km": hard / km if km else np.nan,
                "taken_mean_mps": own.taken_mps.mean(),
                "wave_mean_n": wave.n_vehicles.mean(),
                "wave_mean_m": wave.length_m.mean(),
            }
        )
    return pd.DataFrame(rows)


def _by_actor(poses: pd.DataFrame) -> pd.DataFrame:
    return poses.sort_values(["actor", "step"], kind="stable").reset_index(drop=True)
