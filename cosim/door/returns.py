"""What the methods of a user's own class return, checked: type, shape, dtype, range and order.

Each check takes a `Call` and what was returned. It gives back the same with arrays of its own, so that a class that
keeps and changes an array that it returned changes nothing that was recorded; or it raises `Wrong`.
"""

from dataclasses import dataclass, fields, is_dataclass
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from cosim.adversary.attack import Sending
from cosim.driver.driver import Reasons, SpeedCommands
from cosim.radio.message_round import FrameOutcomes, LosState, MessageRound, Outcome, Receptions
from cosim.v2x.messages import Detections
from results.codes import ObjectClass, Origin
from results.export.moments import Plan, Unit
from results.measure import MetricRow
from sensors.boxes import Boxes
from sensors.reports import Reports
from sensors.scene import Shape
from trust.tables import TrustScores, pair_key

MOST_IDENTITIES = 255
"""Identities of a vehicle beside its own."""
LONGEST_DELAY_S = 3600.0
MOST_COPIES, MOST_REPORTS = 1000, 100_000
FASTEST_MPS = 1000.0
_WORDS = {"f": "floats", "iu": "integers", "b": "bools"}
_PSEUDONYMS = 2**31 - 1


class Wrong(Exception):
    """What a method returned cannot be: "X; Y is due"."""


@dataclass(frozen=True, slots=True)
class Call:
    """A call of a method."""

    given: tuple[Any, ...]
    """Its arguments."""
    made_with: tuple[Any, ...] = ()
    """Arguments of the constructor of its class."""
    latest_step: int | None = None
    """Step in which it is called, where it is not among the arguments."""


def with_article(name: str) -> str:
    """A name with its article."""
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


def described(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, ndarray):
        return f"an array of {value.dtype} of shape {value.shape}"
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, tuple | list):
        return f"a {type(value).__name__} of {len(value)}"
    return with_article(type(value).__name__)


def detached(value: Any) -> Any:
    """The same with copies of its arrays: of an array, a dataclass, or a tuple."""
    if isinstance(value, ndarray):
        return value.copy()
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(detached(item) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        made = object.__new__(type(value))
        for field in fields(value):
            object.__setattr__(made, field.name, detached(getattr(value, field.name)))
        return made
    return value


def anything(call: Call, returned: Any) -> Any:
    """A state of the class's own."""
    return returned


def nothing(call: Call, returned: Any) -> None:
    """No result: the class keeps what it needs."""
    if returned is not None:
        raise Wrong(f"returned {described(returned)}; nothing is due: what the model learns, it keeps in itself")


def pseudonym_changes(call: Call, returned: Any) -> Bool[ndarray, "e"]:
    """Which vehicles change their pseudonyms."""
    _column("", returned, (len(call.given[0].age_s),), "b", "one for each vehicle")
    return detached(returned)


def reports(call: Call, returned: Any) -> Reports:
    """What a detector reports."""
    sweeps, _, boxes = call.given[:3]
    _typed("", returned, Reports, "build it by Reports.of_actors, of_false_positives or concat")
    n = _boxes("boxes", returned.boxes)
    for name, kinds in (("observer", "iu"), ("label", "iu"), ("score", "f"), ("actor", "iu")):
        _column(name, getattr(returned, name), (n,), kinds, "one for each box")
    _column("is_false_positive", returned.is_false_positive, (n,), "b", "one for each box")
    _within("observer", returned.observer, 0, len(sweeps.observers) - 1)
    _within("label", returned.label, 0, len(ObjectClass) - 1)
    _within("score", returned.score, 0, 1)
    _within("actor", np.where(returned.is_false_positive, 0, returned.actor), 0, max(0, len(boxes) - 1))
    return detached(returned)


def speed_commands(call: Call, returned: Any) -> tuple[Any, SpeedCommands]:
    """A driver's state and its commands."""
    world = call.given[1]
    state, commands = _pair(returned, "state", SpeedCommands)
    n = _length("actor", commands.actor)
    _column("actor", commands.actor, (n,), "iu", "")
    _column("speed_mps", commands.speed_mps, (n,), "f", "one for each actor")
    _within("speed_mps", commands.speed_mps, 0, FASTEST_MPS)
    _ascending("actor", commands.actor.astype(np.int64))
    known = world.actor[world.shape != Shape.PEDESTRIAN]
    if (lost := ~np.isin(commands.actor, known)).any():
        raise Wrong(
            f"returned actor = {commands.actor[lost][0]}, no vehicle of this step; numbers out of world.actor are due, "
            "not rows"
        )
    if commands.reasons is not None:
        _typed("reasons", commands.reasons, Reasons, "or None")
        for field in fields(Reasons):
            kinds = "f" if field.name == "gap_m" else "iu"
            _column(f"reasons.{field.name}", getattr(commands.reasons, field.name), (n,), kinds, "one for each command")
    return state, detached(commands)


def message_round(call: Call, returned: Any) -> tuple[Any, MessageRound]:
    """A medium's state and its round of messages."""
    stations, messages = call.given[4:6]
    round_s = call.made_with[1] if len(call.made_with) > 1 else np.inf
    state, happened = _pair(returned, "state", MessageRound)
    if not isinstance(happened.station, ndarray) or not np.array_equal(happened.station, messages.station):
        raise Wrong(f"returned station as {described(happened.station)}; messages.station is due, as it was given")
    got = happened.receptions
    _typed("receptions", got, Receptions, "build it by MessageRound.of")
    n = _length("receptions.receiver", got.receiver)
    for field in fields(Receptions):
        kinds = "iu" if field.name in ("receiver", "message", "hops") else "f"
        _column(f"receptions.{field.name}", getattr(got, field.name), (n,), kinds, "one for each reception")
    _links("receptions", got.receiver, got.message, len(stations), messages)
    _ascending("receptions.receiver, message", pair_key(got.receiver, got.message))
    _within("receptions.hops", got.hops, 1, 2**15)
    _within("receptions.distance_m", got.distance_m, 0, 1e7)
    for name in ("generation_offset_s", "access_delay_s", "latency_s"):
        _within(f"receptions.{name}", getattr(got, name), 0, round_s + 1e-9)
    if (early := got.latency_s < got.access_delay_s).any():
        _row("receptions.latency_s", got.latency_s, early, "not less than access_delay_s: nothing arrives before it is "
             "sent")  # fmt: skip
    if (late := got.received_s > round_s + 1e-9).any():
        _row("receptions.received_s", got.received_s, late, f"at most the {round_s:g} s of a round: later frames are "
             "not received, their outcome is LATE")  # fmt: skip
    _frames(happened.frames, got, len(stations), messages)
    return state, detached(happened)


def _frames(frames: Any, got: Receptions, n_stations: int, messages: Any) -> None:
    _typed("frames", frames, FrameOutcomes, "build it by MessageRound.of")
    n = _length("frames.receiver", frames.receiver)
    for name in ("message", "receiver", "hop", "los_state", "outcome"):
        _column(f"frames.{name}", getattr(frames, name), (n,), "iu", "one for each frame and station in range")
    _column("frames.distance_m", frames.distance_m, (n,), "f", "one for each frame and station in range")
    _column("frames.n_transmissions", frames.n_transmissions, (len(messages),), "iu", "one for each message")
    _links("frames", frames.receiver, frames.message, n_stations, messages)
    _within("frames.hop", frames.hop, 1, 2**15)
    _within("frames.distance_m", frames.distance_m, 0, 1e7)
    _within("frames.los_state", frames.los_state, 0, len(LosState) - 1)
    _within("frames.outcome", frames.outcome, 0, len(Outcome) - 1)
    _within("frames.n_transmissions", frames.n_transmissions, 0, 2**31)
    for name in ("n_relayed", "n_duplicate", "sent_bytes"):
        value = getattr(frames, name)
        if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
            raise Wrong(f"returned frames.{name} as {described(value)}; a number is due")
        if not 0 <= value < 1e18:
            raise Wrong(f"returned frames.{name} = {value}; a number of 0 or more is due")
    if frames.cbr is not None:
        _column("frames.cbr", frames.cbr, (n_stations,), "f", "one for each station, or None")
        _within("frames.cbr", frames.cbr, 0, 1)
    received = frames.outcome == Outcome.RECEIVED
    known = np.isin(pair_key(got.receiver, got.message), pair_key(frames.receiver[received], frames.message[received]))
    if not known.all():
        row = int(np.argmin(known))
        raise Wrong(
            f"returned a reception of message {got.message[row]} at station {got.receiver[row]} of which frames has no "
            "outcome RECEIVED; every reception is due in both: MessageRound.of fills both"
        )


def _links(name: str, receiver: ndarray, message: ndarray, n_stations: int, messages: Any) -> None:
    """Receivers and messages that there are, of messages that were sent, by others."""
    _within(f"{name}.receiver", receiver, 0, n_stations - 1)
    _within(f"{name}.message", message, 0, len(messages) - 1)
    if (unsent := messages.length_bytes[message] == 0).any():
        _row(f"{name}.message", message, unsent, "a message of length_bytes > 0: the others are not sent")
    if (own := messages.station[message] == receiver).any():
        _row(f"{name}.receiver", receiver, own, "another station than the sender of the message")


def trust_scores(call: Call, returned: Any) -> TrustScores:
    """What a trust model says."""
    _typed("", returned, TrustScores, "build it by TrustScores.of")
    s, n = returned, _length("subject", returned.subject)
    columns = {f.name: getattr(s, f.name) for f in fields(TrustScores) if f.name != "step"}
    counts = ["n_evaluators"] if s.n_evaluators is not None else []
    for name in ("holder", "subject", "n_evaluations", "newest_step", "oldest_step", "newest_evaluation_step",
                 "oldest_evaluation_step", *counts):  # fmt: skip
        _column(name, columns[name], (n,), "iu", "one for each (holder, subject)")
    for name in ("trust", "uncertainty", "weight"):
        _column(name, columns[name], (n,), "f", "one for each (holder, subject)")
    _column("is_judged", s.is_judged, (n,), "b", "one for each (holder, subject)")
    now = call.given[0] if call.given and call.given[0] is not None else call.latest_step
    if isinstance(s.step, bool) or not isinstance(s.step, int | np.integer) or (now is not None and s.step > now):
        raise Wrong(f"returned step = {s.step!r}; the step of the call is due, {now}")
    now = int(s.step) if now is None else now
    subject = s.subject
    _within("holder", s.holder, 0, _PSEUDONYMS)
    _within("subject", subject, 0, _PSEUDONYMS)
    _within("trust", s.trust, 0, 1, subject)
    unsure = s.uncertainty[s.is_judged]
    if not np.isnan(unsure).all():
        _within("uncertainty", np.where(s.is_judged, s.uncertainty, 0.0), 0, 1, subject, "; NaN for all rows or none")
    _within("weight", s.weight, 0, np.finfo(float).max, subject)
    _within("n_evaluations", s.n_evaluations, 0, 2**62, subject)
    if (wrong := s.is_judged != (s.n_evaluations > 0)).any():
        _row("is_judged", s.is_judged, wrong, "n_evaluations > 0", subject)
    if s.n_evaluators is not None and (wrong := (s.n_evaluators < 0) | (s.n_evaluators > s.n_evaluations)).any():
        _row("n_evaluators", s.n_evaluators, wrong, "a number from 0 to n_evaluations", subject)
    for name, counted in (("step", np.ones(n, bool)), ("evaluation_step", s.is_judged)):
        newest, oldest = columns[f"newest_{name}"], columns[f"oldest_{name}"]
        if (wrong := counted & (newest > now)).any():
            _row(f"newest_{name}", newest, wrong, f"a step up to {now}, that of the call,", subject)
        if (wrong := counted & (oldest > newest)).any():
            _row(f"oldest_{name}", oldest, wrong, f"not later than newest_{name}", subject)
        if (wrong := counted & (oldest < 0)).any():
            _row(f"oldest_{name}", oldest, wrong, "0 or more", subject)
    _ascending("holder, subject", pair_key(s.holder, s.subject))
    return detached(returned)


def object_scores(call: Call, returned: Any) -> ndarray:
    """Scores that a trust model gives to objects."""
    _column("", returned, (call.given[0].n_groups,), "f", "one score for each object")
    _within("scores", returned, 0, 1)
    return detached(returned)


def attacked_detections(call: Call, returned: Any) -> Detections:
    """The lists that an attack returned; content that no message can hold is dropped later, and counted."""
    listed, context = call.given
    n_world = len(context.world)
    _typed("", returned, Detections, "change the given ones with dataclasses.replace")
    _typed("boxes", returned.boxes, Boxes, "change the given ones with dataclasses.replace")
    n = _length("observer", returned.observer)
    for field in fields(Detections):
        if field.name != "boxes":
            kinds = "b" if field.name == "transmitted" else getattr(listed, field.name).dtype.kind
            kinds = "iu" if kinds in "iu" else kinds
            _column(field.name, getattr(returned, field.name), (n,), kinds, "one for each detection")
    for name, width in (("xyz_m", (n, 3)), ("lwh_m", (n, 3)), ("yaw_rad", (n,))):
        _column(f"boxes.{name}", getattr(returned.boxes, name), width, "f", "one for each detection")
    _within("observer", returned.observer, 0, n_world - 1)
    _within("target", returned.target, 0, n_world - 1)
    _within("origin", returned.origin, 0, len(Origin) - 1)
    _within("identity", returned.identity, 0, MOST_IDENTITIES)
    if len(context.n_identities) and (late := returned.identity > context.n_identities[returned.observer]).any():
        most = context.n_identities[returned.observer[late][0]]
        raise Wrong(
            f"returned identity = {returned.identity[late][0]} of a vehicle with {most} beside its own; at most {most} "
            "is due: identities() says how many there are"
        )
    before, after = (np.bincount(one.observer, minlength=n_world) for one in (listed, returned))
    if (after < before).any():
        raise Wrong(
            f"returned {after.sum()} detections, with some of observer {np.argmax(after < before)} missing; all are "
            "due: one that shall not be sent has transmitted = False"
        )
    honest = [one.take(np.flatnonzero(~context.attacker[one.observer])) for one in (listed, returned)]
    was, now = (one.take(np.lexsort((one.detection_index, one.identity, one.observer))) for one in honest)
    if len(was) != len(now) or not all(map(_same, was.columns(), now.columns())):
        raise Wrong(
            "changed detections of vehicles that do not attack; only rows of context.own_rows(listed) may differ"
        )
    return detached(returned)


def attacked_evaluations(call: Call, returned: Any) -> tuple[ndarray, ndarray]:
    """Evaluation and visibility as an attack sends them."""
    rows, _, context = call.given
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise Wrong(f"returned {described(returned)}; a tuple (evaluation, visibility) is due")
    honest = ~context.attacker[rows.evaluator]
    for name, column, low in zip(("evaluation", "visibility"), returned, (-1, 0), strict=True):
        _column(name, column, rows.evaluation.shape, "f", "one for each row of rows")
        _within(name, column, low, 1)
        if not np.array_equal(column[honest], getattr(rows, name)[honest], equal_nan=True):
            raise Wrong(
                f"changed the {name} of vehicles that do not attack; only rows of context.attacker[rows.evaluator] may "
                "differ"
            )
    return detached(returned)


def identities(call: Call, returned: Any) -> ndarray:
    """Identities of each actor beside its own."""
    _column("", returned, (len(call.given[0].world),), "iu", "one for each actor of the world")
    _within("identities", returned, 0, MOST_IDENTITIES)
    return detached(returned)


def sending(call: Call, returned: Any) -> Sending:
    """How each actor sends."""
    context = call.given[0]
    _typed("", returned, Sending, "begin with Sending.plain(len(context.world))")
    most = {"delay_s": LONGEST_DELAY_S, "n_copies": MOST_COPIES, "n_reports": MOST_REPORTS}
    for name, high in most.items():
        column = getattr(returned, name)
        _column(name, column, (len(context.world),), "f" if name == "delay_s" else "iu", "one for each actor")
        _within(name, column, 0, high)
        if (other := ~context.attacker & (column != 0)).any():
            _row(name, column, other, "0 for actors that do not attack")
    return detached(returned)


def plan(call: Call, returned: Any) -> Plan:
    """The files that an exporter will write."""
    _typed("", returned, Plan, "build it by Plan.of_files([File(path, content), ...])")
    if not isinstance(returned.units, tuple) or not all(isinstance(unit, Unit) for unit in returned.units):
        raise Wrong(f"returned units as {described(returned.units)}; a tuple of Unit is due")
    names = [unit.name for unit in returned.units]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise Wrong(f"returned several units called {twice[0]!r}; a name of its own for each is due")
    return returned


def metric_rows(call: Call, returned: Any) -> list[MetricRow]:
    """What a metric measures."""
    if not isinstance(returned, list | tuple):
        raise Wrong(f"returned {described(returned)}; a list of MetricRow is due")
    for number, row in enumerate(returned):
        if not isinstance(row, MetricRow):
            raise Wrong(f"returned row {number} as {described(row)}; a MetricRow(metric=..., value=...) is due")
        if isinstance(row.value, bool) or not isinstance(row.value, int | float | np.integer | np.floating):
            raise Wrong(f"returned value = {row.value!r} in row {number}; a number is due, NaN where there is none")
        if not all(isinstance(text, str) for text in (row.metric, row.group, row.unit, row.label)) or not row.metric:
            raise Wrong(f"returned row {number} with texts that are none; metric, group, unit and label are due")
    keys = [(row.metric, row.group) for row in returned]
    if len(set(keys)) < len(keys):
        twice = next(key for key in keys if keys.count(key) > 1)
        raise Wrong(f"returned metric {twice[0]!r} twice for group {twice[1]!r}; one row for each group is due")
    return list(returned)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, Boxes):
        return all(map(_same, *([b.xyz_m, b.lwh_m, b.yaw_rad] for b in (one, other))))
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def _typed(name: str, value: Any, of: type, cure: str) -> None:
    if not isinstance(value, of):
        as_name = f"{name} as " if name else ""
        raise Wrong(f"returned {as_name}{described(value)}; {with_article(of.__name__)} is due: {cure}")


def _pair(returned: Any, first: str, of: type) -> tuple[Any, Any]:
    """A state and a result."""
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise Wrong(f"returned {described(returned)}; a tuple ({first}, {of.__name__}) is due")
    if not isinstance(returned[1], of):
        raise Wrong(
            f"returned ({described(returned[0])}, {described(returned[1])}); a tuple ({first}, {of.__name__}) is due"
        )
    return returned


def _boxes(name: str, value: Any) -> int:
    _typed(name, value, Boxes, "build it by Boxes(xyz_m, lwh_m, yaw_rad)")
    n = _length(f"{name}.xyz_m", value.xyz_m)
    for part, width in (("xyz_m", (n, 3)), ("lwh_m", (n, 3)), ("yaw_rad", (n,))):
        _column(f"{name}.{part}", getattr(value, part), width, "f", "one for each box")
        _within(f"{name}.{part}", getattr(value, part), 0 if part == "lwh_m" else -1e7, 1e7)
    return n


def _length(name: str, value: Any) -> int:
    if not isinstance(value, ndarray) or not value.ndim:
        raise Wrong(f"returned {name} as {described(value)}; an array is due")
    return len(value)


def _column(name: str, value: Any, shape: tuple[int, ...], kinds: str, what: str) -> None:
    if not isinstance(value, ndarray) or value.shape != shape or value.dtype.kind not in kinds:
        raise Wrong(
            f"returned {f'{name} as ' if name else ''}{described(value)}; an array of {_WORDS[kinds]} of shape {shape} "
            f"is due{f': {what}' if what else ''}"
        )


def _within(
    name: str, column: ndarray, low: float, high: float, subject: ndarray | None = None, more: str = ""
) -> None:
    with np.errstate(invalid="ignore"):
        wrong = ~((column >= low) & (column <= high))
    if wrong.any():
        wrong = wrong if wrong.ndim == 1 else wrong.any(axis=1)
        top = f"to {high:g}" if high < 1e15 else "or more, finite,"
        _row(name, column, wrong, f"{low:g} {top}{more}", subject)


def _row(name: str, column: ndarray, wrong: Bool[ndarray, "n"], due: str, subject: ndarray | None = None) -> NoReturn:
    """The first wrong row of a column."""
    row, n = int(np.argmax(wrong)), int(wrong.sum())
    of = "" if subject is None else f" of subject {subject[row]}"
    more = f" and {n - 1} more like it" if n > 1 else ""
    raise Wrong(f"returned {name}[{row}] = {column[row]}{of}{more}; {due} is due")


def _ascending(name: str, key: ndarray) -> None:
    if (wrong := np.diff(key) <= 0).any():
        row = int(np.argmax(wrong)) + 1
        raise Wrong(f"returned rows {row - 1} and {row} not ascending by {name}; sorted rows, each once, are due")
