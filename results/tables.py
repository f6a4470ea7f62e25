# ruff: noqa: E501 (a table is wide)
"""Every table and every column of a run, said once: the schemas and the documentation are derived from it."""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Literal

import pyarrow as pa

SCHEMA_VERSION = 3
"""Raised whenever a table or column changes its name, type, unit or meaning."""

Level = Literal["summary", "standard", "full"]
LEVELS: tuple[Level, ...] = ("summary", "standard", "full")

KINDS = ("car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian")
BEHAVIOURS = ("honest", "unreliable", "malicious")
CLASSES = ("car", "pedestrian", "cyclist", "truck")
ORIGINS = ("sensed", "self", "fabricated")
SOURCES = ("server", "own", "default")
MESSAGES = ("detections", "verdicts")
VIEWS = ("open", "wall", "unknown")
PAIRS = ("all", "equipped", "sight")


@dataclass(frozen=True, slots=True)
class Column:
    """One column. What is absent is null (only where `null`), never a sentinel number."""

    type: Literal["int32", "int16", "uint8", "float32", "bool", "string", "category"]
    _: KW_ONLY
    meaning: str
    unit: str = ""
    """Unit, empty for identifiers, counts and flags."""
    key: bool = False
    null: bool = False
    truth: bool = False
    """Known to the simulation only: no vehicle and no server ever reads it."""
    categories: tuple[str, ...] = ()
    """Labels of a category, in the order of their integer codes."""
    bits: int | None = None
    """Binary places kept: stored values are multiples of 2**-bits, which makes files small."""
    via: Literal["", "source", "pose"] = ""
    """Not stored: `open_run` reads it off the detection of this step that `<via>` and `<via>_k` name."""

    @property
    def arrow_type(self) -> pa.DataType:
        if self.type == "category":
            return pa.dictionary(pa.int8(), pa.string())
        return pa.bool_() if self.type == "bool" else getattr(pa, self.type)()

    @property
    def label(self) -> str:
        """Unit in brackets, as an axis shows it."""
        return f"[{self.unit}]" if self.unit else ""


@dataclass(frozen=True, slots=True)
class Table:
    """One table: rows are unique by key and sorted by it within a step."""

    level: Level
    """Lowest record level that keeps the table."""
    meaning: str
    columns: Mapping[str, Column]

    @property
    def key(self) -> tuple[str, ...]:
        return tuple(name for name, column in self.columns.items() if column.key)

    @property
    def stored(self) -> dict[str, Column]:
        """Columns on disk; the others are read off the table `detections`."""
        return {name: column for name, column in self.columns.items() if not column.via}


def _key(meaning: str, type: Literal["int32", "int16"] = "int32") -> Column:
    return Column(type, meaning=meaning, key=True)


def _count(meaning: str) -> Column:
    return Column("int32", meaning=meaning)


# fmt: off
_STEP = _key("Time step; seconds are step * dt_s of the manifest.")
_CLASS = Column("category", meaning="Class of the object.", categories=CLASSES)
_SCORE = Column("float32", meaning="Confidence in [0, 1].", unit="1", bits=12)
_BOX = {
    "x_m": Column("float32", unit="m", meaning="Centre of the box, east.", bits=7),
    "y_m": Column("float32", unit="m", meaning="Centre of the box, north.", bits=7),
    "z_m": Column("float32", unit="m", meaning="Centre of the box, up.", bits=7),
    "length_m": Column("float32", unit="m", meaning="Extent along the heading.", bits=7),
    "width_m": Column("float32", unit="m", meaning="Extent across the heading.", bits=7),
    "height_m": Column("float32", unit="m", meaning="Vertical extent.", bits=7),
    "yaw_rad": Column("float32", unit="rad", bits=9, meaning="Heading, counter-clockwise from +x (east), in (-pi, pi]."),
}
_POSE = ("x_m", "y_m", "z_m", "yaw_rad")
_TRUTH_ACTOR = Column("int32", null=True, truth=True, meaning="Actor that the box really is; null where it is none (clutter, fabricated).")
_TRUTH_IOU = Column("float32", unit="1", null=True, truth=True, bits=10, meaning="3D intersection over union with that actor's true box.")


def _trust_at_contact(one: str, other: str) -> dict[str, Column]:
    return {
        f"trust_{one}{other}": Column("float32", unit="1", null=True, meaning=f"Trust that {one} would use for {other} at first contact; null where {one} has none to use."),
        f"source_{one}{other}": Column("category", null=True, categories=SOURCES, meaning="Where that trust came from."),
        f"age_{one}{other}_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of that trust; null for the default."),
        f"trusted_after_{one}{other}_s": Column("float32", unit="s", null=True, meaning=f"From the start until {one} first used a value for {other} other than the default; null if it never did."),
    }


_MESSAGE = Column("category", key=True, categories=MESSAGES, meaning="What is said in the round: own detections, or verdicts on those of others; beside the verdicts, roadside units broadcast trust values.")
_IN_REACH = _count("(Frame, radio) pairs within reach, relayed frames included: what could have been heard.")
_DELIVERED = _count("Of these, received.")
_LOST = {
    "n_lost_propagation": _count("Lost to distance, obstacles, shadowing or fading."),
    "n_lost_collision": _count("Lost to interference of other senders."),
    "n_lost_receiver_busy": _count("Lost because the receiver was sending or locked to another frame."),
    "n_lost_expired": _count("Never sent: lifetime over in the sender's queue."),
    "n_lost_late": _count("Received after the time-out of the exchange, and dropped."),
}

TABLES: Mapping[str, Table] = {
    "vehicles": Table(
        "summary",
        "Everyone who moved in the run, one row each, written at its end.",
        {
            "vehicle": _key("Actor id, unique in the run and never reused."),
            "sumo_id": Column("string", meaning="Name in SUMO."),
            "kind": Column("category", meaning="Kind of actor.", categories=KINDS),
            "length_m": Column("float32", unit="m", meaning="Extent along the heading."),
            "width_m": Column("float32", unit="m", meaning="Extent across the heading."),
            "height_m": Column("float32", unit="m", meaning="Vertical extent."),
            "equipped": Column("bool", meaning="Carries a sensor and a radio."),
            "behaviour": Column("category", meaning="What an equipped vehicle does to its own messages; null if not equipped.", categories=BEHAVIOURS, null=True),
            "first_step": Column("int32", meaning="First step on the road."),
            "last_step": Column("int32", meaning="Last step on the road."),
            "first_lie_step": Column("int32", null=True, meaning="Step of its first message that was tampered with; null if none was."),
        },
    ),
    "actors": Table(
        "standard",
        "Poses of everyone, pedestrians included: enough to replay the traffic without SUMO.",
        {
            "step": _STEP,
            "actor": _key("Actor id, as in `vehicles`."),
            **{name: replace(_BOX[name], bits=bits) for name, bits in (("x_m", 8), ("y_m", 8), ("z_m", 8), ("yaw_rad", 9))},
            "speed_mps": Column("float32", unit="m/s", meaning="Speed along the heading.", bits=8),
        },
    ),
    "encounters": Table(
        "summary",
        "Meetings of two actors: an unbroken time within a radius of each other.",
        {
            "a": _key("The smaller of the two actor ids."),
            "b": _key("The larger of the two actor ids."),
            "start_step": _key("First step in contact."),
            "radius_m": Column("float32", unit="m", key=True, meaning="Largest distance that counts as contact."),
            "pairs": Column("category", key=True, categories=PAIRS, meaning="Who can meet: all actors, equipped pairs, or equipped pairs while they see each other."),
            "end_step": Column("int32", meaning="First step no longer in contact."),
            "duration_s": Column("float32", unit="s", meaning="(end_step - start_step) * dt_s, bridged gaps included."),
            "censored_left": Column("bool", meaning="In contact already when recording began: lasted longer."),
            "censored_right": Column("bool", meaning="Not over when recording ended: lasted longer."),
            "entered": Column("bool", meaning="Began because one of the two entered the simulation."),
            "departed": Column("bool", meaning="Ended because one of the two left the simulation."),
            "gap_s": Column("float32", unit="s", null=True, meaning="Time since the last meeting ended; null at the first."),
            "min_distance_m": Column("float32", unit="m", meaning="Smallest distance in contact."),
            "mean_distance_m": Column("float32", unit="m", meaning="Mean distance over the steps in contact."),
            "los_share": Column("float32", unit="1", meaning="Share of the steps in contact with line of sight."),
            "n_messages_ab": _count("Messages of a that b received during the encounter."),
            "n_messages_ba": _count("Messages of b that a received during the encounter."),
            "n_verdicts_ab": _count("Verdicts of a on detections of b during the encounter."),
            "n_verdicts_ba": _count("Verdicts of b on detections of a during the encounter."),
            **_trust_at_contact("a", "b"),
            **_trust_at_contact("b", "a"),
        },
    ),
    "sightings": Table(
        "standard",
        "What every sensor could have seen: one row per actor that at least one of its beams would meet in a free field.",
        {
            "step": _STEP,
            "observer": _key("Vehicle whose sensor it is."),
            "actor": _key("Actor in its field of view."),
            "n_points": Column("int32", truth=True, meaning="Returns that it really gave."),
            "n_unoccluded": Column("int32", truth=True, meaning="Returns that it would give if nothing stood in front."),
        },
    ),
    "detections": Table(
        "standard",
        "Boxes in the vehicles' lists, before the radio; (step, observer, k) is a detection's name for life.",
        {
            "step": _STEP,
            "observer": _key("Vehicle that made the detection."),
            "k": _key("Position in its list; 0 is its self report.", "int16"),
            "class": _CLASS,
            **_BOX,
            "score": _SCORE,
            "n_points": _count("Returns of the observer's own sweep in the box."),
            "kind": Column("category", categories=ORIGINS, truth=True, meaning="Seen by its sensor, its self report, or made up by a lying sender."),
            "said": Column("bool", truth=True, meaning="Is in the message that was sent (a sender may hide what it saw)."),
            "truth_actor": _TRUTH_ACTOR,
            "truth_iou": _TRUTH_IOU,
            "truth_occlusion": Column("float32", unit="1", null=True, truth=True, bits=8, meaning="Share of that actor hidden from the observer."),
        },
    ),
    "deliveries": Table(
        "full",
        "Messages that arrived.",
        {
            "step": _key("Step in which the message was sent."),
            "message": _MESSAGE,
            "sender": _key("Vehicle that made the message."),
            "receiver": _key("Vehicle that received it."),
            "hops": Column("uint8", meaning="Radio hops taken; 1 is direct."),
            "generated_s": Column("float32", unit="s", bits=20, meaning="From the beginning of the round to the generation of the message."),
            "access_s": Column("float32", unit="s", bits=20, meaning="From generation until its author's (last) frame was on the air."),
            "latency_s": Column("float32", unit="s", bits=20, meaning="From generation to reception."),
            "distance_m": Column("float32", unit="m", bits=5, meaning="Between sender and receiver, when sent."),
        },
    ),
    "radio": Table(
        "summary",
        "The channel, all of the city together.",
        {
            "step": _STEP,
            "message": _MESSAGE,
            "n_sent": _count("Frames sent, relayed copies included."),
            "n_relayed": _count("Of these, relayed copies."),
            "n_in_reach": _IN_REACH,
            "n_delivered": _DELIVERED,
            "n_duplicate": _count("Of these, messages that the receiver had already."),
            **_LOST,
            "bytes": Column("float32", unit="B", meaning="Sent on the air, relayed copies included."),
            "busy_ratio": Column("float32", unit="1", null=True, meaning="Share of time that a vehicle hears the channel busy, mean over vehicles; null where not modelled."),
        },
    ),
    "links": Table(
        "summary",
        "The channel by distance between sender and receiver.",
        {
            "step": _STEP,
            "message": _MESSAGE,
            "ring_m": Column("int16", unit="m", key=True, meaning="Lower edge of the ring of distance."),
            "view": Column("category", key=True, categories=VIEWS, meaning="Between the two ends: no building, a building, or not asked (models without walls)."),
            "n_in_reach": _IN_REACH,
            "n_delivered": _DELIVERED,
            **_LOST,
        },
    ),
    "latencies": Table(
        "summary",
        "Messages between vehicles by their latency, from generation to reception.",
        {
            "step": _STEP,
            "message": _MESSAGE,
            "latency_s": Column("float32", unit="s", key=True, meaning="Lower edge of the bin; bins are a factor of the square root of 2 wide."),
            "n_delivered": _count("Messages received, each once per receiver."),
        },
    ),
    "silences": Table(
        "summary",
        "Time between successive messages of one vehicle at another, while the two stay within reach of each other: bursts of loss.",
        {
            "step": _key("Time step in which the silence ended; seconds are step * dt_s of the manifest."),
            "message": _MESSAGE,
            "gap_steps": _key("Steps from the last reception to the next, or to the last step within reach; one sensing interval where nothing was lost."),
            "n_received": _count("Silences that a reception ended."),
            "n_parted": _count("Silences that were not over when the two got out of reach, or one left: they would have lasted longer (0 steps: parted right after a reception)."),
        },
    ),
    "ears": Table(
        "standard",
        "What the radio of each equipped vehicle met with, both rounds of messages together.",
        {
            "step": _STEP,
            "vehicle": _key("Vehicle that listens."),
            "busy_ratio": Column("float32", unit="1", null=True, bits=8, meaning="Share of time that it hears the channel busy; null where not modelled."),
            "n_in_reach": Column("int16", meaning="Messages of vehicles within reach of it."),
            "n_heard": Column("int16", meaning="Messages of vehicles that it received, relayed ones included."),
        },
    ),
    "server": Table(
        "summary",
        "The way to the trust server and back; only where there is one.",
        {
            "step": _STEP,
            "n_reports": _count("Reports with verdicts that vehicles had for the server."),
            "n_reached": _count("Of these, those that reach it, in this step or later."),
            "n_lost": _count("Of these, lost on the way, or heard by no roadside unit."),
            "n_over_capacity": _count("Of these, dropped because their cell was full."),
            "n_outage": _count("Of these, lost because the server was away."),
            "up_bytes": Column("float32", unit="B", meaning="Length of all reports, headers included, where they go by cellular."),
            "n_addressed": _count("Vehicles on the road when trust values were broadcast; 0 where none were."),
            "n_informed": _count("Of these, those that the broadcast reaches, in this step or later."),
        },
    ),
    "verdicts": Table(
        "standard",
        "What hearers thought of each other's detections.",
        {
            "step": _key("Step of the detection."),
            "evaluator": _key("Vehicle that judged it."),
            "observer": _key("Vehicle that made the detection."),
            "k": _key("Position in its list.", "int16"),
            "judged_step": Column("int32", meaning="Step in which it was judged."),
            "e": Column("float32", unit="1", bits=12, meaning="Evaluation: the score of the match, negative where denied."),
            "visibility": Column("float32", unit="1", bits=12, meaning="How well the evaluator could have seen it, in [0, 1]: the weight of e."),
            "n_points": _count("Returns of the evaluator's own sweep in the box."),
            "plausible": Column("bool", null=True, meaning="Free-space test in its own sweep; null where not asked."),
            "matched": Column("bool", meaning="Matched a detection of the evaluator's own."),
        },
    ),
    "trust": Table(
        "summary",
        "What the trust server thinks of each vehicle, at every step in which it computes.",
        {
            "step": _STEP,
            "vehicle": _key("Vehicle judged."),
            "trust": Column("float32", unit="1", meaning="Trust in [0, 1]."),
            "weight": Column("float32", unit="1", meaning="Sum of the weights of the detections behind it."),
            "n_evaluations": _count("Evaluations behind it."),
            "newest_age_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of the newest of them; null where there is none."),
            "oldest_age_s": Column("float32", unit="s", null=True, bits=10, meaning="Age of the oldest of them; null where there is none."),
        },
    ),
    "uses": Table(
        "standard",
        "Trust values really used: one row per receiver and vehicle that it heard.",
        {
            "step": _STEP,
            "receiver": _key("Vehicle that used the value."),
            "subject": _key("Vehicle that the value is about."),
            "trust": Column("float32", unit="1", meaning="Value used, in [0, 1]."),
            "source": Column("category", categories=SOURCES, meaning="From the server, from own experience, or the default."),
            "age_s": Column("float32", unit="s", null=True, bits=10, meaning="Time since the server computed it; of an own value, age of the newest evaluation behind it; null for the default."),
        },
    ),
    "fused": Table(
        "standard",
        "What each vehicle believes in the end: its own boxes and those of others that it accepts.",
        {
            "step": _STEP,
            "observer": _key("Vehicle that believes it."),
            "k": _key("Position in its list.", "int16"),
            "class": replace(_CLASS, via="source"),
            **{name: replace(column, via="pose" if name in _POSE else "source") for name, column in _BOX.items()},
            "score": _SCORE,
            "n_witnesses": Column("int16", meaning="Vehicles with a detection of it, the observer included."),
            "local": Column("bool", meaning="Detected by the observer itself."),
            "source": Column("int32", meaning="Vehicle whose detection of this step gave the box."),
            "source_k": Column("int16", meaning="Position of that detection in its list."),
            "pose": Column("int32", null=True, meaning="Vehicle whose detection gave position and heading, where that was another one."),
            "pose_k": Column("int16", null=True, meaning="Position of that detection in its list."),
            "fabricated": Column("bool", truth=True, meaning="The box was made up by a lying sender."),
            "truth_actor": replace(_TRUTH_ACTOR, via="source"),
            "truth_iou": replace(_TRUTH_IOU, via="source", meaning="3D intersection over union of the box, as its source gave it, with that actor's true box."),
        },
    ),
}
# fmt: on


def kept(level: Level) -> tuple[str, ...]:
    """Names of the tables that a run of this record level holds."""
    return tuple(name for name, table in TABLES.items() if LEVELS.index(table.level) <= LEVELS.index(level))


def schema(name: str, whole: bool = False) -> pa.Schema:
    """Arrow schema of a table on disk, with unit and meaning as field metadata; `whole`, of all its columns."""
    table = TABLES[name]
    fields = [
        pa.field(
            label,
            column.arrow_type,
            nullable=column.null,
            metadata={"unit": column.unit, "meaning": column.meaning, "key": str(column.key).lower()},
        )
        for label, column in (table.columns if whole else table.stored).items()
    ]
    return pa.schema(fields, {"table": name, "schema_version": str(SCHEMA_VERSION), "meaning": table.meaning})


def axis_label(table: str, column: str, text: str | None = None) -> str:
    """Axis label with the column's unit: `axis_label("trust", "newest_age_s", "Age")` is `Age [s]`."""
    found = TABLES[table].columns[column]
    name = text or column.replace("_", " ")
    return f"{name} [{found.unit}]" if found.unit not in ("", "1") else name


def _row(name: str, column: Column) -> str:
    kind = f"category: {', '.join(column.categories)}" if column.categories else column.type
    notes = [
        *(["key"] if column.key else []),
        *(["may be null"] if column.null else []),
        *(["truth"] if column.truth else []),
        *([f"to 1/{2**column.bits}"] if column.bits else []),
        *([f"by `{column.via}`"] if column.via else []),
    ]
    return f"| `{name}` | {kind} | {column.unit} | {', '.join(notes)} | {column.meaning} |"


def markdown() -> str:
    """The dictionary as Markdown, the text of `results/TABLES.md`."""
    lines = [
        "# Tables of a run",
        "",
        f"Schema version {SCHEMA_VERSION}. Written from `results/tables.py` by `python -m results.tables`.",
        "",
        "`key` columns together name a row. `truth` columns are known to the simulation only. `to 1/256` says",
        "that stored values are rounded to that fraction of the unit. ``by `source` `` says that the column is not in",
        "the files: it is that of the row of `detections` with the same `step` whose `observer` and `k` are `source` and",
        "`source_k` (for `pose`: `pose` and `pose_k` where they are not null); `open_run` puts it in place.",
        "",
        "Levels contain one another:",
        *(
            f"`{level}` keeps {', '.join(f'`{name}`' for name in kept(level))}{'.' if level == 'full' else ';'}"
            for level in LEVELS
        ),
    ]
    for name, table in TABLES.items():
        lines += [
            "",
            f"## {name}",
            f"{table.meaning} Kept from level `{table.level}` up. Key: {', '.join(table.key)}.",
            "",
            "| column | type | unit | notes | meaning |",
            "|---|---|---|---|---|",
            *(_row(label, column) for label, column in table.columns.items()),
        ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("TABLES.md").write_text(markdown())
