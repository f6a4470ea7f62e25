"""Checks of the results of a user's own class: type, shape, dtype, range and order.

Each check takes a `Call` and its result, and raises `Wrong` if the result is not valid. Otherwise it returns the result
with copies of its arrays. If the class later changes an array that it returned, recorded values do not change.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from cosim.attacks.attack import LOUDEST_DBM, Sending
from cosim.base.codes import LosState, ObjectClass, Origin
from cosim.base.rows import Rows
from cosim.messages.content import FABRICATED, LEAST_ACCURACY_FACTOR, MOST_ACCURACY_FACTOR, Detections, faults
from cosim.radio.message_round import FrameOutcomes, MessageRound, Outcome, Receptions
from cosim.traffic.driver import Reasons, SpeedCommands
from sensors.boxes import Boxes
from sensors.reports import Reports
from sensors.scene import Shape
from trust.tables import TrustScores, pair_key

if TYPE_CHECKING:
    from results.moments import Plan
    from results.own_metrics import MetricRow

MOST_IDENTITIES = 255
"""Largest number of identities of a vehicle in addition to its own."""
LONGEST_DELAY_S = 3600.0
MOST_COPIES, MOST_REPORTS = 1000, 100_000
FASTEST_MPS = 1000.0
FARTHEST_M = 1e7
MOST_HOPS = 2**15
LARGEST_NAME = 2**31 - 1
_CODES = frozenset({"label", "los_state", "origin"})
"""Columns of codes, which have 8 bits."""
_WORDS = {"f": "floats", "iu": "integers", "b": "bools"}


class Wrong(Exception):
    """A method returned a wrong result. The message says what it did and, if given, what is expected."""

    def __init__(self, found: str, expected: str = "") -> None:
        super().__init__(f"{found}, but {expected} is expected" if expected else found)


@dataclass(frozen=True, slots=True)
class Call:
    """A call of a method."""

    given: tuple[Any, ...]
    """Its arguments."""
    made_with: tuple[Any, ...] = ()
    """Arguments of the constructor of its class."""
    latest_step: int | None = None
    """Step of the call, if it is not among the arguments."""


def with_article(name: str) -> str:
    """A name with its article."""
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


def described(value: Any) -> str:
    """A value in a few words."""
    if type(value) is ndarray:
        return f"an array of {value.dtype} of shape {value.shape}"
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, tuple | list):
        return f"a {type(value).__name__} of {len(value)}"
    return with_article(type(value).__name__)


def detached(value: Any, like: ndarray | None = None) -> Any:
    """Copy an array, or a dataclass or tuple of arrays, in the dtypes that the program uses.

    Narrow integers would overflow in sums and products, and compiled functions do not accept floats of other widths.
    `like` is an array of the expected dtype, if that is known.
    """
    if isinstance(value, ndarray):
        usual = {"f": np.float64, "b": np.bool_}.get(value.dtype.kind, np.int64)
        return np.array(value, usual if like is None else like.dtype, order="C")
    if type(value) is tuple:
        return tuple(map(detached, value))
    if is_dataclass(value) and not isinstance(value, type):
        made = object.__new__(type(value))
        for field in fields(value):
            column = getattr(value, field.name)
            of = np.zeros(0, np.uint8) if field.name in _CODES else None
            object.__setattr__(made, field.name, detached(column, of))
        return made
    return value


def anything(call: Call, returned: Any) -> Any:
    """A state, which may be anything."""
    return returned


def nothing(call: Call, returned: Any) -> None:
    """No result: the class stores what it needs."""
    if returned is not None:
        raise Wrong(f"returned {described(returned)}", "no result (the model stores what it learns)")


def pseudonym_changes(call: Call, returned: Any) -> Bool[ndarray, "e"]:
    """Which vehicles change their pseudonyms."""
    _column("", returned, (len(call.given[0].age_s),), "b", "one for each vehicle")
    return detached(returned)


def reports(call: Call, returned: Any) -> Reports:
    """The reports of a detector."""
    sweeps, _, boxes = call.given[:3]
    _typed("", returned, Reports, "build it by Reports.of_actors, of_false_positives or concat")
    n = _check_boxes(returned.boxes)
    _columns(
        "",
        returned,
        n,
        "one for each box",
        {
            "observer": ("iu", 0, len(sweeps.observers) - 1),
            "label": ("iu", 0, len(ObjectClass) - 1),
            "score": ("f", 0, 1),
            "actor": ("iu",),
            "is_false_positive": ("b",),
        },
    )
    actor = np.where(returned.is_false_positive, 0, returned.actor)
    _within("actor", actor, 0, max(0, len(boxes) - 1))
    _within("boxes.yaw_rad", returned.boxes.yaw_rad, -2 * np.pi, 2 * np.pi)  # messages say no others
    xyz_m, reach_m = returned.boxes.xyz_m, 2 * sweeps.max_range_m
    away_m = np.linalg.norm(xyz_m - sweeps.poses.origin_m[returned.observer], axis=1)
    _none("boxes.xyz_m", xyz_m, away_m > reach_m, f"a place in the world frame within {reach_m:g} m of the observer")
    return detached(returned)


def speed_commands(call: Call, returned: Any) -> tuple[Any, SpeedCommands]:
    """A driver's state and its commands."""
    world = call.given[1]
    state, commands = _with_state(returned, SpeedCommands)
    n = _length("actor", commands.actor)
    _columns("", commands, n, "one for each actor", {"actor": ("iu",), "speed_mps": ("f", 0, FASTEST_MPS)})
    _ascending("actor", commands.actor.astype(np.int64))
    is_vehicle = (world.shape != Shape.PEDESTRIAN) & ~world.is_roadside
    lost = ~np.isin(commands.actor, world.actor[is_vehicle])
    _none("actor", commands.actor, lost, "a vehicle of this step by its number in world.actor, not its row,")
    if commands.reasons is not None:
        _typed("reasons", commands.reasons, Reasons, "or None")
        _columns(
            "reasons.",
            commands.reasons,
            n,
            "one for each command",
            {
                "source_step": ("iu",),
                "source": ("iu",),
                "source_index": ("iu",),
                "gap_m": ("f",),
            },
        )
    return state, detached(commands)


def message_round(call: Call, returned: Any) -> tuple[Any, MessageRound]:
    """A medium's state and its round of messages."""
    stations, messages = call.given[4:6]
    round_s = call.made_with[1] if len(call.made_with) > 1 else np.inf
    state, happened = _with_state(returned, MessageRound)
    if not isinstance(happened.station, ndarray) or not np.array_equal(happened.station, messages.station):
        raise Wrong(f"returned station as {described(happened.station)}", "the given messages.station")
    if happened.earlier != ():
        raise Wrong(
            "returned messages of earlier rounds", "none: a message of a medium of your own ends with its round"
        )
    got, frames, at, last_s = happened.receptions, happened.frames, "receptions.", round_s + 1e-9
    _typed("receptions", got, Receptions, "build it by MessageRound.of")
    _columns(
        at,
        got,
        _length(f"{at}receiver", got.receiver),
        "one for each reception",
        {
            "receiver": ("iu",),
            "message": ("iu",),
            "hops": ("iu", 1, MOST_HOPS),
            "distance_m": ("f", 0, FARTHEST_M),
            "generation_offset_s": ("f", 0, last_s),
            "access_delay_s": ("f", 0, last_s),
            "latency_s": ("f", 0, last_s),
        },
    )
    _check_links(at, got, len(stations), messages)
    pairs = pair_key(got.receiver, got.message)
    _ascending(f"{at}receiver, message", pairs)
    _none(f"{at}latency_s", got.latency_s, got.latency_s < got.access_delay_s, "access_delay_s or more")
    _none(f"{at}received_s", got.received_s, got.received_s > last_s, f"at most {round_s:g} s, the length of a round,")
    _check_frames(frames, len(stations), messages)
    of_frames = pair_key(frames.receiver, frames.message)
    known = np.isin(pairs, of_frames[frames.outcome == Outcome.RECEIVED])
    _none(f"{at}message", got.message, ~known, "a message whose frame has the outcome RECEIVED at the receiver")
    return state, detached(happened)


def _check_frames(frames: Any, n_stations: int, messages: Any) -> None:
    """The outcomes of the frames of a round."""
    at = "frames."
    _typed("frames", frames, FrameOutcomes, "build it by MessageRound.of")
    _columns(
        at,
        frames,
        _length(f"{at}receiver", frames.receiver),
        "one for each frame and station in range",
        {
            "message": ("iu",),
            "receiver": ("iu",),
            "hop": ("iu", 1, MOST_HOPS),
            "distance_m": ("f", 0, FARTHEST_M),
            "los_state": ("iu", 0, len(LosState) - 1),
            "outcome": ("iu", 0, len(Outcome) - 1),
        },
    )
    _check_links(at, frames, n_stations, messages)
    _columns(at, frames, len(messages), "one for each message", {"n_transmissions": ("iu", 0, 2**31)})
    if frames.cbr is not None:
        _columns(at, frames, n_stations, "one for each station, or None", {"cbr": ("f", 0, 1)})
    for name in ("n_relayed", "n_duplicate", "sent_bytes"):
        _positive(f"{at}{name}", getattr(frames, name), 1e18)


def _check_links(at: str, rows: Any, n_stations: int, messages: Any) -> None:
    """Receivers and messages must exist, messages must have been sent, and receivers must not be the senders."""
    receiver, message = rows.receiver, rows.message
    _within(f"{at}receiver", receiver, 0, n_stations - 1)
    _within(f"{at}message", message, 0, len(messages) - 1)
    _none(f"{at}message", message, messages.length_bytes[message] == 0, "a message that is sent, of length_bytes > 0,")
    _none(f"{at}receiver", receiver, messages.station[message] == receiver, "another station than the sender")


def trust_scores(call: Call, returned: Any) -> TrustScores:
    """The scores of a trust model."""
    _typed("", returned, TrustScores, "build it by TrustScores.of")
    s, subject = returned, returned.subject
    given = call.given[0] if call.given else None
    now = call.latest_step if given is None else given
    is_step = isinstance(s.step, int | np.integer)
    is_step = is_step and not isinstance(s.step, bool)
    if not is_step or (now is not None and s.step > now):
        due = "" if now is None else f", {now},"
        raise Wrong(f"returned step = {s.step!r}", f"the step of the call{due}")
    now = int(s.step) if now is None else now
    large = np.finfo(float).max
    _columns(
        "",
        s,
        _length("subject", subject),
        "one for each (holder, subject)",
        {
            "holder": ("iu", 0, LARGEST_NAME),
            "subject": ("iu", 0, LARGEST_NAME),
            "trust": ("f", 0, 1),
            "uncertainty": ("f",),
            "weight": ("f", 0, large),
            "n_evaluations": ("iu", 0, 2**62),
            "newest_step": ("iu",),
            "oldest_step": ("iu",),
            "newest_evaluation_step": ("iu",),
            "oldest_evaluation_step": ("iu",),
            "is_evaluated": ("b",),
        },
    )
    if not np.isnan(s.uncertainty[s.is_evaluated]).all():
        unsure = np.where(s.is_evaluated, s.uncertainty, 0.0)
        _none("uncertainty", unsure, ~((unsure >= 0) & (unsure <= 1)), "0 to 1, or NaN in all rows,", subject)
    _none("is_evaluated", s.is_evaluated, s.is_evaluated != (s.n_evaluations > 0), "n_evaluations > 0", subject)
    if s.n_evaluators is not None:
        _columns("", s, len(subject), "one for each (holder, subject)", {"n_evaluators": ("iu", 0, 2**62)})
        _none("n_evaluators", s.n_evaluators, s.n_evaluators > s.n_evaluations, "0 to n_evaluations", subject)
    all_rows = np.ones(len(subject), bool)
    for what, counts in (("step", all_rows), ("evaluation_step", s.is_evaluated)):
        newest, oldest = getattr(s, f"newest_{what}"), getattr(s, f"oldest_{what}")
        _none(f"newest_{what}", newest, counts & (newest > now), f"a step up to {now}, that of the call,", subject)
        _none(f"oldest_{what}", oldest, counts & (oldest > newest), f"not later than newest_{what}", subject)
        _none(f"oldest_{what}", oldest, counts & (oldest < -1), "0 or more, or -1 if it is not kept,", subject)
    _ascending("holder, subject", pair_key(s.holder, subject))
    return detached(returned)


def object_scores(call: Call, returned: Any) -> ndarray:
    """Scores that a trust model gives to objects."""
    _column("", returned, (call.given[0].n_groups,), "f", "one score for each object")
    _within("scores", returned, 0, 1)
    return detached(returned)


def _check_detections(returned: Any, n_world: int) -> None:
    """Detections of a world of so many actors, whatever their content is."""
    _typed("", returned, Detections, "change the given ones with dataclasses.replace")
    n = _length("observer", returned.observer)
    _check_boxes(returned.boxes, n, is_bounded=False)
    _columns(
        "",
        returned,
        n,
        "one for each detection",
        {
            "observer": ("iu", 0, n_world - 1),
            "target": ("iu", 0, n_world - 1),
            "origin": ("iu", 0, len(Origin) - 1),
            "identity": ("iu", 0, MOST_IDENTITIES),
            "detection_index": ("iu",),
            "label": ("iu", 0, 255),
            "score": ("f",),
            "n_points": ("iu",),
            "transmitted": ("b",),
            "speed_mps": ("f",),
            "acceleration_mps2": ("f",),
            "accuracy_factor": ("f", LEAST_ACCURACY_FACTOR, MOST_ACCURACY_FACTOR),
        },
    )
    _column("velocity_mps", returned.velocity_mps, (n, 2), "f", "east and north of each detection")


def phantoms(call: Call, returned: Any) -> Detections:
    """What detectors found, with the phantoms that an attack added."""
    seen, context = call.given
    _check_detections(returned, len(context.world))
    added = returned.origin == FABRICATED
    kept = returned.take(np.flatnonzero(~added))
    if len(kept) != len(seen) or not _same(kept, seen):
        raise Wrong("changed rows of seen", "the given rows with phantoms added by fabricated(seen, ...)")
    _none("target", returned.target, added & ~context.attacker[returned.target], "an attacker")
    _none("observer", returned.observer, added & ~np.isin(returned.observer, seen.observer), "an observer in seen")
    unlike = faults(returned, context.world.boxes.xyz_m) >= 0
    _none("detection_index", returned.detection_index, added & unlike, "of a phantom that a message can contain")
    return detached(returned)


def attacked_detections(call: Call, returned: Any) -> Detections:
    """The lists that an attack returned. Content that no message can contain is dropped and counted later."""
    listed, context = call.given
    n_world = len(context.world)
    _check_detections(returned, n_world)
    if len(context.n_identities):
        late = returned.identity > context.n_identities[returned.observer]
        _none("identity", returned.identity, late, "at most the number that identities() says of the vehicle")
    before, after = (np.bincount(one.observer, minlength=n_world) for one in (listed, returned))
    if (after < before).any():
        raise Wrong(
            f"left out detections of observer {np.argmax(after < before)}",
            "every detection (with transmitted = False if it is not sent)",
        )

    def honest(lists: Detections) -> Detections:
        kept = lists.take(~context.attacker[lists.observer])
        return kept.take(np.lexsort((kept.detection_index, kept.identity, kept.observer)))

    was, now = honest(listed), honest(returned)
    if len(was) != len(now) or not _same(was, now):
        raise Wrong("changed detections of other vehicles, but only rows of context.own_rows(listed) may differ")
    return detached(returned)


def attacked_evaluations(call: Call, returned: Any) -> tuple[ndarray, ndarray]:
    """Evaluation and visibility as an attack sends them."""
    rows, _, context = call.given
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise Wrong(f"returned {described(returned)}", "a tuple (evaluation, visibility)")
    honest = ~context.attacker[rows.evaluator]
    for name, column, low in zip(("evaluation", "visibility"), returned, (-1, 0), strict=True):
        _column(name, column, rows.evaluation.shape, "f", "one for each row of rows")
        _within(name, column, low, 1)
        if not _same(column[honest], getattr(rows, name)[honest]):
            raise Wrong(f"changed the {name} of other vehicles, but only context.attacker[rows.evaluator] may differ")
    return detached(returned)


def identities(call: Call, returned: Any) -> ndarray:
    """Number of identities of each actor in addition to its own."""
    n_world = len(call.given[0].world)
    _column("", returned, (n_world,), "iu", "one for each actor of the world")
    _within("identities", returned, 0, MOST_IDENTITIES)
    return detached(returned)


def sending(call: Call, returned: Any) -> Sending:
    """How each actor sends."""
    context = call.given[0]
    _typed("", returned, Sending, "begin with Sending.plain(len(context.world))")
    _columns(
        "",
        returned,
        len(context.world),
        "one for each actor of the world",
        {
            "delay_s": ("f", 0, LONGEST_DELAY_S),
            "n_copies": ("iu", 0, MOST_COPIES),
            "n_reports": ("iu", 0, MOST_REPORTS),
            "jam_dbm": ("f", -np.inf, LOUDEST_DBM),
            "react_dbm": ("f", -np.inf, LOUDEST_DBM),
            "ignores_dcc": ("b",),
        },
    )
    plain, honest_row = Sending.plain(len(context.world)), Sending.plain(1)
    for field in fields(Sending):
        column, honest = getattr(returned, field.name), getattr(plain, field.name)
        lawless = ~context.attacker & (column != honest)
        _none(field.name, column, lawless, f"{getattr(honest_row, field.name)[0]:g} for actors that do not attack")
    return detached(returned)


def one_each(high: float) -> Callable[[Call, Any], ndarray]:
    """A check of what a detector says of each object: a number from 0 to `high`."""

    def checked(call: Call, returned: Any) -> ndarray:
        _column("", returned, (len(call.given[0]),), "f", "one for each object")
        _within("", returned, 0, high)
        return detached(returned)

    return checked


def plan(call: Call, returned: Any) -> "Plan":
    """The files that an exporter will write."""
    from results.moments import Plan, Unit

    _typed("", returned, Plan, "build it by Plan.of_files([File(path, content), ...])")
    if not _is_tuple_of(returned.units, Unit):
        raise Wrong(f"returned units as {described(returned.units)}", "a tuple of Unit")
    names = [unit.name for unit in returned.units]
    for unit in returned.units:
        if not isinstance(unit.name, str) or not unit.name.isprintable() or not unit.name:
            raise Wrong(f"returned a unit called {unit.name!r}", "a name in one line")
        if not callable(unit.files):
            raise Wrong(f"returned files of unit {unit.name!r} as {described(unit.files)}", "a function")
    for name in ("n_sweeps", "bytes_per_point", "text_bytes"):
        _positive(name, getattr(returned, name))
    if not _is_tuple_of(returned.remarks, str):
        raise Wrong(f"returned remarks as {described(returned.remarks)}", "a tuple of texts")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise Wrong(f"returned several units called {twice[0]!r}", "a name of its own for each")
    return returned


def _is_tuple_of(value: Any, of: type) -> bool:
    """Whether a value is a tuple whose items have this type."""
    return isinstance(value, tuple) and all(isinstance(item, of) for item in value)


def metric_rows(call: Call, returned: Any) -> "list[MetricRow]":
    """The rows of a metric."""
    from results.metrics.registry import METRICS
    from results.own_metrics import LARGEST, MetricRow, is_value

    if not isinstance(returned, list | tuple):
        raise Wrong(f"returned {described(returned)}", "a list of MetricRow")
    for number, row in enumerate(returned):
        if not isinstance(row, MetricRow):
            raise Wrong(f"returned row {number} as {described(row)}", "a MetricRow(metric=..., value=...)")
        if not is_value(row.value):
            raise Wrong(
                f"returned value = {repr(row.value)[:40]} in row {number}",
                f"a number of at most {LARGEST:g} in size (NaN if there is none)",
            )
        texts = row.metric, row.group, row.unit, row.label
        if not _is_tuple_of(texts, str) or not row.metric:
            raise Wrong(f"returned row {number} with a wrong text", "a text as metric, group, unit and label")
        if row.metric in METRICS:
            raise Wrong(f"returned {row.metric}, a metric that cosim has", "another name")
    keys = [(row.metric, row.group) for row in returned]
    if len(set(keys)) < len(keys):
        twice = next(key for key in keys if keys.count(key) > 1)
        raise Wrong(f"returned metric {twice[0]!r} twice for group {twice[1]!r}", "one row for each group")
    return list(returned)


def _same(one: Any, other: Any) -> bool:
    """Whether two columns, or two tables, are equal."""
    if isinstance(one, Rows):
        names = [field.name for field in fields(one)]  # type: ignore[arg-type]
        return all(_same(getattr(one, name), getattr(other, name)) for name in names)
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def _is_number(value: Any) -> bool:
    """Whether a value is a number and no bool."""
    is_number = isinstance(value, int | float | np.integer | np.floating)
    return is_number and not isinstance(value, bool)


def _positive(name: str, value: Any, below: float = np.nan) -> None:
    """Raise `Wrong` if a value is not a number of 0 or more, and below a limit."""
    if not _is_number(value) or not value >= 0 or value >= below:
        raise Wrong(f"returned {name} as {described(value)}", "a number of 0 or more")


def _typed(name: str, value: Any, of: type, cure: str) -> None:
    """Raise `Wrong` if a value is of another type."""
    if not isinstance(value, of):
        as_name = f"{name} as " if name else ""
        raise Wrong(f"returned {as_name}{described(value)}", f"{with_article(of.__name__)} ({cure})")


def _with_state(returned: Any, of: type) -> tuple[Any, Any]:
    """The returned pair of a state and a result. For anything else, `Wrong` is raised."""
    is_pair = isinstance(returned, tuple) and len(returned) == 2
    if not is_pair or not isinstance(returned[1], of):
        shown = f"({', '.join(map(described, returned))})" if is_pair else described(returned)
        raise Wrong(f"returned {shown}", f"a tuple (state, {of.__name__})")
    return returned


def _check_boxes(boxes: Any, n: int | None = None, is_bounded: bool = True) -> int:
    """Check boxes and return their number. If they are not valid boxes, `Wrong` is raised."""
    _typed("boxes", boxes, Boxes, "build it by Boxes(xyz_m, lwh_m, yaw_rad)")
    n = _length("boxes.xyz_m", boxes.xyz_m) if n is None else n
    for name, width in (("xyz_m", (3,)), ("lwh_m", (3,)), ("yaw_rad", ())):
        column, full_name = getattr(boxes, name), f"boxes.{name}"
        _column(full_name, column, (n, *width), "f", "one for each box")
        if is_bounded:
            low = 0 if name == "lwh_m" else -FARTHEST_M
            _within(full_name, column, low, FARTHEST_M)
    return n


def _length(name: str, value: Any) -> int:
    """Number of rows of an array. If the value is not an array, `Wrong` is raised."""
    if type(value) is not ndarray or not value.ndim:
        raise Wrong(f"returned {name} as {described(value)}", "an array")
    return len(value)


def _columns(
    prefix: str,
    value: Any,
    n: int,
    what: str,
    expected: Mapping[str, tuple[Any, ...]],
) -> None:
    """Check the columns of a dataclass, each with n rows. `expected` has the kinds of dtype and the bounds of each."""
    for name, (kinds, *bounds) in expected.items():
        column, full_name = getattr(value, name), f"{prefix}{name}"
        _column(full_name, column, (n,), kinds, what)
        if bounds:
            low, high = bounds
            _within(full_name, column, low, high, getattr(value, "subject", None))


def _column(
    name: str,
    value: Any,
    shape: tuple[int, ...],
    kinds: str,
    what: str,
) -> None:
    """Raise `Wrong` if a value is not an array of this shape and these kinds of dtype."""
    if type(value) is not ndarray or value.shape != shape or value.dtype.kind not in kinds:
        raise Wrong(
            f"returned {f'{name} as ' if name else ''}{described(value)}",
            f"an array of {_WORDS[kinds]} of shape {shape} ({what})",
        )


def _within(name: str, column: ndarray, low: float, high: float, subject: ndarray | None = None) -> None:
    """Raise `Wrong` if a number is out of bounds or not a number."""
    with np.errstate(invalid="ignore"):
        wrong = ~((column >= low) & (column <= high))
    right = f"{low:g} to {high:g}" if high < 1e15 else f"{low:g} or more"
    _none(name, column, wrong, right, subject)


def _none(
    name: str, column: ndarray, wrong: Bool[ndarray, "n ..."], expected: str, subject: ndarray | None = None
) -> None:
    """Raise `Wrong` if any row of a column is wrong, with the first such row."""
    if not wrong.any():
        return
    n = int(wrong.sum())
    row = int(np.argmax(wrong.reshape(len(wrong), -1).any(axis=1)))
    of = "" if subject is None else f" of subject {subject[row]}"
    more = f" and {n - 1} more like it" if n > 1 else ""
    raise Wrong(f"returned {name}[{row}] = {column[row]}{of}{more}", expected)


def _ascending(name: str, key: ndarray) -> None:
    """Raise `Wrong` if rows are not sorted, or one of them occurs twice."""
    if (wrong := np.diff(key) <= 0).any():
        row = int(np.argmax(wrong)) + 1
        raise Wrong(
            f"returned rows {row - 1} and {row} not ascending by {name}", "an ascending order without repetitions"
        )
