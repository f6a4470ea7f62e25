"""A tiny step to call extensions with: six actors, of which the first three attack; one class per file."""

from types import SimpleNamespace

import numpy as np

from cosim.attacks.attack import AttackContext, EvaluationRows
from cosim.door.guard import make
from cosim.door.kinds import KINDS
from cosim.door.load import load_own
from cosim.messages.content import Detections, self_reports
from cosim.messages.pseudonyms import PseudonymAges
from cosim.radio.message_round import Messages, RoundKind, Stations
from cosim.traffic.driver import Beliefs
from cosim.world import World
from sensors.evidence import Observability
from sensors.reports import DetectorDraws
from sensors.scene import Shape
from tests.sensors.town import boxes_at
from trust.object_reports import ObjectReports
from trust.tables import EvaluationMessages, ReceivedEvaluations

N, STEP, ROUND_S = 6, 5, 0.4
HEADER = """
from dataclasses import dataclass, field, replace
import numpy as np
from cosim.extend import *
"""


def world():
    """Six actors in a row; the last one is a pedestrian. Numbers are not rows."""
    x_m = 20.0 * np.arange(N)
    boxes = boxes_at(np.column_stack([x_m, 0 * x_m, 0 * x_m + 0.75]), (4.4, 1.8, 1.5), 0 * x_m)
    shape = np.full(N, Shape.CAR, np.uint8)
    shape[-1] = Shape.PEDESTRIAN
    return World(
        step=STEP, actor=np.arange(10, 10 + N, dtype=np.int32), name_key=np.arange(N, dtype=np.uint64) + 1, shape=shape,
        boxes=boxes, speed_mps=np.full(N, 10.0), equipped=np.ones(N, bool), attack=np.zeros(N, np.uint8),
    )  # fmt: skip


def attack():
    """Arguments of each hook of an attack."""
    here, attacker = world(), np.arange(N) < 3
    listed = Detections.by_key([self_reports(here, np.arange(N))])
    context = AttackContext(here, attacker, 5.0, 1, 0, member=attacker)
    rows = EvaluationRows(
        np.repeat(np.arange(N), N), np.tile(np.arange(N), N), np.full(N * N, 0.5), np.full(N * N, 0.75)
    )
    return {
        "detections": (listed, context), "evaluations": (rows, listed, context), "identities": (context,),
        "sending": (context,), "phantoms": (listed, context),
    }  # fmt: skip


def policy():
    """Arguments of the hook of a pseudonym policy."""
    n = np.arange(N)
    ages = PseudonymAges(
        n_changes=n, age_s=n * 1.0, distance_m=n * 9.0, away_m=n * 8.0, beyond_s=np.zeros(N), n_messages=n,
        trip_draws=np.full((N, 4), 0.5), step_draws=np.full(N, 0.5),
    )  # fmt: skip
    return {"changes": (ages,)}


def medium():
    """Arguments of the hooks of a radio medium; the last station sends nothing."""
    here = world()
    stations = Stations(here.name_key, here.boxes.xyz_m, N)
    messages = Messages.one_each(np.array([300] * (N - 1) + [0]))
    return {"start": (), "broadcast": (None, RoundKind.CPM, STEP, 5.0, stations, messages)}


def detector():
    """Arguments of the hook of a detector: two observers, each of which sees three actors."""
    here, keys = world(), np.arange(2, dtype=np.uint64)
    observer, actor = np.repeat([0, 1], 3).astype(np.int32), np.array([1, 2, 3, 0, 2, 3], np.int32)
    returns = np.full(6, 30, np.int32)
    seen = Observability(observer, actor, returns, returns + 5, np.full(6, 20.0))
    draws = DetectorDraws(5.0, here.name_key, keys, keys, np.uint64(1), keys, keys)
    poses = SimpleNamespace(origin_m=here.boxes.xyz_m[:2])
    sweeps = SimpleNamespace(observers=np.arange(2), poses=poses, max_range_m=100.0)
    return {"detect": (sweeps, seen, here.boxes, here.label, draws)}


def driver():
    """Arguments of the hook of a driver."""
    here, n = world(), np.arange(3)
    beliefs = Beliefs(5.4, n, here.label[:3], here.boxes.take(n), np.full(3, 0.5), np.zeros(3, bool), n, n, n)
    return {"commands": (None, here, beliefs, 0.5)}


def trust():
    """Arguments of the hooks of a trust model: pseudonyms 1, 2, 3 evaluate each other's self reports."""
    n = np.arange(1, 4)
    messages = EvaluationMessages(
        STEP, n, np.arange(0, 10, 3), np.tile(n, 3), np.zeros(9, int), np.full(9, 0.5), np.ones(9)
    )
    reports = ObjectReports(np.array([0, 1, 1]), np.array([True, True, False]), np.ones(3), np.full(3, 0.5), 2)
    return {
        "open_step": (STEP, n, np.arange(3), np.zeros(3, int), np.ones(3)),
        "add_evaluations": (ReceivedEvaluations(messages, np.zeros(3, int), np.arange(3)),),
        "scores": (STEP,),
        "score_objects": (reports,),
    }


def exporter():
    """Arguments of the hook of an exporter; it is called with no run here."""
    return {"plan": (SimpleNamespace(),)}


def metric():
    """The same of a metric."""
    return {"rows": (SimpleNamespace(),)}


SCENES = {f.__name__: f for f in (attack, policy, medium, detector, driver, trust, exporter, metric)}
ARGUMENTS = {"medium": (ROUND_S, 1, None), "trust": (1.0,)}
"""Of constructors, after `params`."""


def play(path, kind):
    """Load the class `Mine` of a file, make one, and call each of its hooks once."""
    choice = load_own(f"{path}:Mine", KINDS[kind])
    params = () if choice.params is None else (choice.params(),)
    if not params and KINDS[kind].section_params:
        params = (SimpleNamespace(),)
    mine = make(choice, *params, *ARGUMENTS.get(kind, ()))
    return {name: getattr(mine, name)(*given) for name, given in SCENES[kind]().items() if hasattr(mine, name)}
