"""Road users: sizes, walking speeds, and what receivers say of their positions."""

from jaxtyping import Float
from numpy import ndarray
from scipy import stats

from cosim.addons.compare.runs import DEFAULT_WORLD
from cosim.base.codes import OBJECT, PARKED
from cosim.config.config import load
from results.run import Run

MEASURES = ("actor_size", "walking_speed", "position_error")


def actor_size(run: Run, *, vehicle_class: str) -> Float[ndarray, "3"]:
    """Mean length, width and height of a class [m]; what stands there by the config does not count."""
    columns = ["length_m", "width_m", "height_m"]
    table = run.table("vehicles", ["sumo_id", "vehicle_class", *columns])
    drives = ~table.sumo_id.str.startswith((PARKED, OBJECT))
    mine = table[drives & (table.vehicle_class == vehicle_class)]
    if mine.empty:
        raise ValueError(f"{run.path.name}: there is no {vehicle_class} in this run.")
    return mine[columns].astype(float).mean().to_numpy()


def walking_speed(run: Run, *, moving_mps: float) -> list[float]:
    """Mean speed of pedestrians while they walk, each pedestrian once [m/s]."""
    kinds = run.table("vehicles", ["vehicle", "vehicle_class"])
    on_foot = kinds.vehicle[kinds.vehicle_class == "pedestrian"]
    poses = run.table("actors", ["actor", "speed_mps"])
    poses = poses[poses.actor.isin(on_foot) & (poses.speed_mps > moving_mps)]
    return [float(poses.speed_mps.astype(float).groupby(poses.actor).mean().mean())]


def position_error(*, share: float) -> list[float]:
    """Radius within which this share of the position errors of the default world lies [m]."""
    return [load(None, [DEFAULT_WORLD]).gnss.std_m * float(stats.rayleigh.ppf(share))]
