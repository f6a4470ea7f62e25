"""A person steps out in front of a standing bus: what the own sensor sees late, an oncoming vehicle sees early.

100 cases by default, each played three times with the same draws: believing the own detector alone (`local`), everybody
(`any`), and TruPercept (`trupercept_3`). Run as `python -m tests.verification.pedestrian_behind_bus [N]`.

The scene, in metres: the ego drives along y = 0 towards +x at a constant speed v until it brakes. A bus of 12 m stands
in the next lane, its middle at y = -3.2, its front at x = 0. A person stands at (1.5, -4.2), and walks towards +y at
1.4 m/s so that it would be in the middle of the ego's lane when the front bumper of an ego that does not brake is at
x = 1.5. An equipped car comes from the other side, at y = +3.2. Bodies are those of `Boxes`; radio, detector, trust and
driver are those of a run.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.base import rng
from cosim.config.config import load
from cosim.step.cycle import step
from cosim.step.parts import Parts
from cosim.step.state import State
from cosim.world import LanePaths, World
from sensors.boxes import Boxes
from sensors.scene import Scene, Shape

STEP_S, BEFORE_S, WALK_MPS, PERSON_X_M = 0.1, 4.5, 1.4, 1.5
METHODS = ("local", "any", "trupercept_3")
SHAPES = np.array([Shape.CAR, Shape.CAR, Shape.BUS, Shape.PEDESTRIAN], np.uint8)
SIZES = np.array([[4.6, 1.8, 1.5], [4.6, 1.8, 1.5], [12.0, 2.5, 3.1], [0.5, 0.6, 1.75]])
NAMES = np.array(
    [rng.name_key(name) for name in ("vehicle/ego", "vehicle/oncoming", "vehicle/bus", "person/p")], np.uint64
)
EGO, ONCOMING, BUS, PERSON = range(4)
LINE = np.array([[-400.0, 0.0], [400.0, 0.0]])


@dataclass(frozen=True)
class Outcome:
    """What became of a case."""

    brake_s: float
    """First command to brake for the person, before (negative) an ego that does not brake would be there; NaN: none."""
    impact_mps: float
    """Speed at which the ego reaches the person; 0 where it does not."""
    least_gap_m: float
    """Smallest distance from the front bumper to the person while it is in the lane's corridor."""


def play(case: int, method: str) -> Outcome:
    """One case with one way of believing; everything but the belief is drawn from the number of the case."""
    draw = np.random.default_rng(case)
    v, oncoming_m, oncoming_mps = draw.uniform(8, 14), draw.uniform(20, 60), draw.uniform(0, 10)
    config = load(None, [
        f"seed={case}", f"traffic.step_s={STEP_S}", "sensing_interval_s=0.3", "driver.model=cautious",
        "driver.own_persons=true", "driver.persons_ahead_s=2.0", f"trust.method={method}",
        "attacks.0.share_p=0", "attacks.1.share_p=0",
        "trust.server_period_s=1",
    ])  # fmt: skip
    parts = Parts.of(config, Scene.empty())
    state, front_m, speed, first_s, least_m, impact = State.start(parts), -v * BEFORE_S, v, np.nan, np.inf, 0.0
    for number in range(round((BEFORE_S + 3.0) / STEP_S)):
        time_s = number * STEP_S - BEFORE_S  # 0: an ego that does not brake is at the origin
        reach_s = time_s - PERSON_X_M / v
        y_m = max(-4.2, WALK_MPS * reach_s)
        world = scene(number, front_m, speed, oncoming_m - oncoming_mps * time_s, oncoming_mps, y_m, y_m > -4.2)
        state, result = step(world, state, parts)
        commands = result.commands
        if EGO in commands.actor:
            wanted = float(commands.speed_mps[np.flatnonzero(commands.actor == EGO)[0]])
            assert result.reactions is not None, "the cautious driver gives reasons"
            reacted = result.reactions
            for_person = (commands.actor == EGO) & reacted.is_real & (reacted.truth_actor == PERSON)
            if np.isnan(first_s) and wanted < speed - 0.05 and for_person.any():
                first_s = reach_s
            speed = min(wanted, v)
        elif speed < v:
            speed = min(v, speed + 2.6 * STEP_S)
        gap_m = PERSON_X_M - 0.25 - front_m
        if abs(y_m) < 0.9 + 0.3:  # half of the car, half of the person
            least_m = min(least_m, max(gap_m, 0.0)) if gap_m > -4.6 else least_m
            if -4.6 < gap_m <= 0:
                impact = max(impact, speed)
                break
        if y_m > 1.5 or front_m > PERSON_X_M + 6:
            break
        front_m += speed * STEP_S
    return Outcome(first_s, impact, least_m)


def scene(
    number: int, front_m: float, speed: float, oncoming_m: float, oncoming_mps: float, y_m: float, walks: bool
) -> World:
    """The world of a step."""
    xy = np.array([[front_m - 2.3, 0.0], [oncoming_m, 3.2], [-6.0, -3.2], [PERSON_X_M, y_m]])
    boxes = Boxes(np.column_stack([xy, SIZES[:, 2] / 2]), SIZES, np.array([0.0, np.pi, 0.0, np.pi / 2]))
    paths = LanePaths(
        np.array([EGO, ONCOMING]), np.array([0, 1]), np.array([front_m + 400.0, 0.0]), np.array([0, 2, 4]),
        np.concatenate([LINE, [[oncoming_m - 2.3, 3.2], [-800.0, 3.2]]]),
        np.array([0.0, 800.0, 0.0, oncoming_m - 2.3 + 800.0]),
    )  # fmt: skip
    speeds = np.array([speed, oncoming_mps, 0.0, WALK_MPS * walks])
    equipped = np.array([True, True, False, False])
    return World(
        number, np.arange(4, dtype=np.int32), NAMES, SHAPES, boxes, speeds, equipped, np.zeros(4, np.uint8), paths
    )


def compare(n: int) -> dict[str, list[Outcome]]:
    """The cases 0 to n - 1, by method."""
    return {method: [play(case, method) for case in range(n)] for method in METHODS}


def report(found: dict[str, list[Outcome]]) -> str:
    """A line per method; intervals of paired differences by 2,000 bootstrap samples of the cases."""
    local = np.array([o.brake_s for o in found["local"]])
    lines = []
    for method, outcomes in found.items():
        brake = np.array([o.brake_s for o in outcomes])
        hits = np.array([o.impact_mps > 0 for o in outcomes])
        both = ~np.isnan(brake) & ~np.isnan(local)
        earlier = (local - brake)[both]
        draws = np.random.default_rng(1).integers(0, len(earlier), (2000, len(earlier)))
        low, high = np.quantile(earlier[draws].mean(axis=1), [0.025, 0.975])
        lines.append(
            f"{method}: brakes in {np.sum(~np.isnan(brake))} of {len(brake)}; "
            f"{earlier.mean():.2f} s earlier than local [{low:.2f}, {high:.2f}] (median {np.median(earlier):.2f} s, "
            f"{len(earlier)} pairs); reaches the person in {hits.sum()}, mean speed then "
            f"{np.mean([o.impact_mps for o in outcomes if o.impact_mps > 0] or [0.0]):.1f} m/s"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    result = report(compare(int(sys.argv[1]) if len(sys.argv) > 1 else 100))
    sys.stdout.write(result + "\n")
    if len(sys.argv) > 2:
        Path(sys.argv[2]).write_text(result + "\n", encoding="utf-8")
