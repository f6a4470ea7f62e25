"""OPV2V, V2XSet, V2X-Real, V2V4Real and sets in their layout, as OpenCOOD reads them.

Notes
-----
`SCENARIO/AGENT/%06d.yaml`, in a folder `train`, `validate` or `test` or not. `lidar_pose` is x, y, z, roll, yaw and
pitch in degrees, or a matrix of 4 x 4. `location` and `center` add up to the middle of the box, `extent` is half of its
size, `angle` is roll, yaw and pitch. The same object has one number (`ass_id`, else its key) for all agents. Its class
is `obj_type`, else car. Objects are in `vehicles`; other keys at the top whose values have `location` and `extent` hold
objects too, and are named by their class (UrbanIng-V2X).

The frame of the objects is a property of the data set, which the files do not state: in OPV2V they are in the world, in
V2V4Real in the frame of the agent's LiDAR. `_frame` decides by evidence.

The ego of a scenario is the agent whose name comes first as text; agents with negative numbers are roadside units and
come last. Frames in which the ego has no file are left out, as in OpenCOOD.

Detections: `%06d_pred.npy` with corners [n, 8, 3] in the frame of the agent's LiDAR, as OpenCOOD saves predictions, and
`%06d_score.npy` [n] beside them. They have no class.   Deviations: pitch and roll of objects are left out; several
roadside units all come last.
"""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.perception.recorded import (
    MOST_BOXES,
    MOST_FRAMES,
    Recorded,
    RecordedBoxes,
    array_of,
    box_of_corners,
    class_of,
    listed,
    matrix,
    moved,
    numbers,
    once,
    pose_of,
    read_text,
    rigid,
    scores,
    upright,
)

ObjectFrame = Literal["world", "lidar"]
"""In which frame annotated objects are."""
Votes = dict[ObjectFrame, int]
"""By frame, how much speaks for it."""
Stamps = dict[Path, dict[int, dict[str, Path]]]
"""Annotation files by scenario, time stamp and agent."""
Listed = tuple[ndarray, ndarray] | None
"""Detected boxes in the frame of the LiDAR, and their scores; None if there is no file."""

_SAME_M, _APART_M = 2.0, 4.0
"""Annotations of one object by two agents are nearer than the first, and those of different ones farther apart than the
second: clocks and poses of agents differ a little."""
_ON_AGENT_M = 5.0
"""An annotation with the name of an agent is this agent if it is so near to its LiDAR, and else an object."""
_FAR_M = 300.0
"""No LiDAR sees objects beyond."""
_FEWEST = 3
"""Detections that show that objects beside poses of six numbers are not in the world."""
_MOST_YAML = 2_000_000
"""Largest YAML file [B]: its reader is slow, and annotations have a few hundred kilobytes."""


@dataclass(frozen=True, slots=True)
class _Agent:
    """What one file says."""

    name: str
    path: Path
    world_from: Float[ndarray, "4 4"]
    is_matrix: bool
    key: tuple[str, ...]
    """Numbers of the objects."""
    kind: tuple[str, ...]
    """Their classes, as the file says."""
    box: Float[ndarray, "n 7"]
    """Their boxes, in the frame in which the file has them."""
    has_objects: bool
    """Whether the file has a place for objects, empty or not."""

    def seen(self, frame: ObjectFrame) -> Float[ndarray, "n 7"]:
        """The boxes in the world."""
        return self.box if frame == "world" else moved(self.box, self.world_from)


@dataclass(frozen=True, slots=True)
class _Moment:
    """The agents of one time stamp, the ego first."""

    name: str
    agents: tuple[_Agent, ...]


def stamps(folder: Path) -> Stamps:
    """Annotation files by scenario, time stamp and agent.

    Raises
    ------
    ValueError
        In one line, if there are too many, or an agent has two files of one time stamp.
    """
    by_agent: dict[Path, list[Path]] = defaultdict(list)
    for path in folder.rglob("*.yaml"):
        if re.fullmatch("[0-9]{1,18}", path.stem) and len(path.relative_to(folder).parts) >= 2:
            by_agent[path.parent].append(path)
    found: Stamps = defaultdict(lambda: defaultdict(dict))
    for agent, paths in sorted(by_agent.items()):
        for number, path in once(paths).items():
            found[agent.parent][number][agent.name] = path
    if (n := sum(map(len, found.values()))) > MOST_FRAMES:
        raise ValueError(f"{folder} has {n:,} time stamps, more than {MOST_FRAMES:,}. Name one scenario.")
    return found


def is_roadside(agent: str) -> bool:
    """Whether an agent is a roadside unit by its name, a negative number."""
    return re.fullmatch("-[0-9]+", agent) is not None


def read(
    folder: Path, detections: Path | None = None, ego: str | None = None, objects: ObjectFrame | None = None
) -> Recorded:
    """A folder of scenarios.

    Parameters
    ----------
    detections
        Folder with the same tree that holds the detections; left out, they lie beside the annotations.
    ego
        Name of the agent that is the ego of every scenario; left out, that of OpenCOOD.
    objects
        Frame of the annotated objects; left out, it is found out.
    """
    moments, remarks = _moments(folder, ego)
    every = [agent for moment in moments for agent in moment.agents]
    remarks += _about_keys(every)
    local = {agent.path: _detections(agent, detections, folder) for agent in every}
    frame, why = (objects, "") if objects else _frame(moments, local)
    if why:
        remarks.append(f"the objects are taken as in the frame of the {_SAID[frame]}: {why}.")
    truth, aside, more = _objects_of(moments, frame)
    remarks += more + _about_missing(local, every)
    found = []
    for number, moment in enumerate(moments):
        for k, agent in enumerate(moment.agents):
            mine = _in_world(local[agent.path], agent)
            found += [(number, k, "car", box, score) for box, score in mine]
    classes = Counter((kind, class_of(kind)) for agent in every for kind in agent.kind)
    return Recorded(
        layout="opv2v",
        frames=tuple(moment.name for moment in moments),
        agents=tuple(tuple(agent.name for agent in moment.agents) for moment in moments),
        pose=tuple(np.array([pose_of(agent.world_from) for agent in moment.agents]) for moment in moments),
        truth=truth,
        aside=aside,
        found=RecordedBoxes.of(found),
        has_classes=False,
        classes=classes,
        remarks=tuple(remarks),
        world_from=tuple(np.array([agent.world_from for agent in moment.agents]) for moment in moments),
        clouds=tuple(tuple(agent.path.with_suffix(".pcd") for agent in moment.agents) for moment in moments),
    )


_SAID = {"world": "world", "lidar": "agent's LiDAR"}


def _moments(folder: Path, ego: str | None) -> tuple[list[_Moment], list[str]]:
    """All time stamps of which the ego has a file, and a remark on the others."""
    found, n_without = [], 0
    everybody = stamps(folder)

    def rank(name: str) -> tuple[bool, bool, str]:
        return name != ego, is_roadside(name), name

    order_of = {}
    for scenario, of in everybody.items():
        order_of[scenario] = sorted(set[str]().union(*of.values()), key=rank)
    names = sorted(set().union(*order_of.values()))
    if ego is not None and ego not in names:
        raise ValueError(f"--ego {ego}: there is no such agent in {folder}. There are: {', '.join(names[:20])}.")
    for scenario, of in sorted(everybody.items()):
        order = order_of[scenario]
        for _, files in sorted(of.items()):
            if order[0] not in files or ego not in (None, order[0]):
                n_without += 1
                continue
            agents = tuple(_agent(files[name]) for name in order if name in files)
            found.append(_Moment(f"{scenario.name}/{files[order[0]].stem}", agents))
    if not found:
        raise ValueError(f"{folder}: the ego has no file in any frame.")
    remark = f"{n_without:,} frames are left out: their ego has no file there."
    return found, [remark] if n_without else []


def _agent(path: Path) -> _Agent:
    """What a file says of its agent and its objects."""
    about = _yaml(path)
    world_from, is_matrix = _pose(about, path)
    keys, kinds, boxes = [], [], []
    for kind, key, one in _annotations(about, path):
        keys.append(_number_of(one, key, path))
        kinds.append(kind)
        boxes.append(_box(one, key, path))
    return _Agent(
        name=path.parent.name,
        path=path,
        world_from=world_from,
        is_matrix=is_matrix,
        key=tuple(keys),
        kind=tuple(kinds),
        box=np.array(boxes).reshape(-1, 7),
        has_objects="vehicles" in about or bool(boxes),
    )


def _annotations(
    about: dict[str, Any],
    path: Path,
) -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Class, key and annotation of each object of a file."""
    n = 0
    for place, listed_there in about.items():
        if place == "vehicles" and listed_there is None:
            continue
        if place == "vehicles" and not isinstance(listed_there, dict):
            raise ValueError(f"{path}: vehicles should be objects by number, at most {MOST_BOXES:,}.")
        if place != "vehicles" and not _holds_objects(listed_there):
            continue
        n += len(listed_there)
        if n > MOST_BOXES:
            raise ValueError(f"{path} has {n:,} objects, more than {MOST_BOXES:,}.")
        for key, one in listed_there.items():
            if not isinstance(one, dict):
                what = f"{str(place)[:40]}.{str(key)[:40]}"
                raise ValueError(f"{path}: {what} should hold angle, center, extent and location.")
            of_place = "Car" if place in ("vehicles", "objects") else str(place)[:40]
            yield str(one.get("obj_type") or of_place)[:40], key, one


def _holds_objects(value: Any) -> bool:
    """Whether a value at the top of a file holds objects by number."""
    if not isinstance(value, dict) or not value:
        return False
    objects = [one for one in value.values() if isinstance(one, dict)]
    if len(objects) < len(value):
        return False
    return all({"location", "extent"} <= one.keys() for one in objects)


def _number_of(one: dict[str, Any], key: Any, path: Path) -> str:
    """What names an object for all agents: its key, or `object N` if it has a number of association besides.

    The key may be the name of an agent; a number of association is not.
    """
    same = one.get("ass_id", key)
    if isinstance(same, int) and same < 0:
        return f"{path.parent.name}:{key}"
    return str(key) if str(same) == str(key) else f"object {same}"


def _box(one: dict[str, Any], key: Any, path: Path) -> Float[ndarray, "7"]:
    which = str(key)[:40]
    angle, center, extent, location = (
        numbers(one.get(name), 3, f"{which}.{name}", path) for name in ("angle", "center", "extent", "location")
    )
    if (extent <= 0).any():
        raise ValueError(f"{path}: {which}.extent should be above 0.")
    middle, yaw_rad = location + center, math.radians(angle[1])
    box = np.array([*middle, *(2 * extent), yaw_rad])
    return upright(box[None], path)[0]


def _frame(moments: Sequence[_Moment], local: dict[Path, Listed]) -> tuple[ObjectFrame, str]:
    """In which frame the objects are, and the evidence if it is not what the form of the poses suggests.

    The first of these that decides: where two agents put the same object; on which reading detections lie on objects;
    on which reading objects are within the reach of a LiDAR; whether both readings are the same.

    Raises
    ------
    ValueError
        In one line, if agents contradict each other, or poses are matrices and nothing decides.
    """
    every = [agent for moment in moments for agent in moment.agents]
    is_matrix = any(agent.is_matrix for agent in every)
    usual: ObjectFrame = "lidar" if is_matrix else "world"
    agreed = _agreements(moments)
    if min(agreed.values()) * 9 > max(agreed.values()):
        raise ValueError(
            f"{every[0].path.parents[1]}: {agreed['world']:,} objects are at one place for two agents if they are in "
            f"the frame of the world, and {agreed['lidar']:,} if in that of the LiDAR. Name the frame: --objects world "
            "or --objects lidar."
        )
    evidence: tuple[tuple[Callable[[], Votes], str], ...] = (
        (lambda: agreed, "{:,} objects that two agents annotate are at one place only then"),
        (
            lambda: _on_objects(every, local, usual, 1 if is_matrix else _FEWEST),
            "{:,} detections lie on objects only then",
        ),
        (lambda: _within_reach(every), "otherwise most objects are beyond the reach of a LiDAR"),
    )
    for count, words in evidence:
        votes = count()
        if any(votes.values()):
            frame = max(votes, key=lambda one: votes[one])
            return frame, words.format(votes[frame]) if frame != usual else ""
    differs = [0.0]
    for agent in every:
        between = agent.seen("lidar") - agent.box
        differs.append(np.abs(between).max(initial=0.0))
    if is_matrix and max(differs) > 0.1:
        raise ValueError(
            f"{every[0].path.parents[1]}: nothing tells whether the objects are in the frame of the world, or in that "
            "of the agent's LiDAR as in V2V4Real. Name it: --objects world or --objects lidar."
        )
    return usual, ""


def _agreements(moments: Sequence[_Moment]) -> Votes:
    """By frame, number of objects that two agents have at one place in it, and not in the other."""
    votes: Votes = {"world": 0, "lidar": 0}
    apart_m = {frame: [np.zeros(0)] for frame in votes}
    for moment in moments:
        for one, other in combinations(moment.agents, 2):
            at = {key: row for row, key in enumerate(one.key)}
            theirs = [row for row, key in enumerate(other.key) if key in at]
            ours = [at[other.key[row]] for row in theirs]
            if theirs:
                for frame in votes:
                    ours_m = one.seen(frame)[ours, :2]
                    between_m = ours_m - other.seen(frame)[theirs, :2]
                    apart_m[frame].append(np.linalg.norm(between_m, axis=1))
    world, lidar = (np.concatenate(apart_m[frame]) for frame in votes)
    votes["world"] = int(((world < _SAME_M) & (lidar > world + _SAME_M)).sum())
    votes["lidar"] = int(((lidar < _SAME_M) & (world > lidar + _SAME_M)).sum())
    return votes


def _on_objects(every: Sequence[_Agent], local: dict[Path, Listed], usual: ObjectFrame, fewest: int) -> Votes:
    """By frame, number of detections that lie on an object in it; nothing if the difference is small.

    At least `fewest` speak for another frame than the usual one.
    """
    votes: Votes = {"world": 0, "lidar": 0}
    for agent in every:
        given = local[agent.path]
        if given is None or not len(given[0]) or not len(agent.box):
            continue
        boxes = moved(given[0], agent.world_from)
        for frame in votes:
            objects = cKDTree(agent.seen(frame)[:, :2])
            away_m, _ = objects.query(boxes[:, :2])
            votes[frame] += int((away_m < _SAME_M).sum())
    most = max(votes, key=lambda one: votes[one])
    are_enough = most == usual or votes[most] >= fewest
    is_clear = are_enough and 3 * min(votes.values()) < votes[most]
    return votes if is_clear else {"world": 0, "lidar": 0}


def _within_reach(every: Sequence[_Agent]) -> Votes:
    """The frame in which the middle object is within the reach of a LiDAR, if it is in one of them only."""
    votes: Votes = {"world": 0, "lidar": 0}
    for frame in votes:
        places = [np.zeros((0, 2))]
        for agent in every:
            here_m = agent.world_from[:2, 3]
            places.append(agent.seen(frame)[:, :2] - here_m)
        away_m = np.linalg.norm(np.concatenate(places), axis=1)
        is_near = len(away_m) > 0 and np.median(away_m) <= _FAR_M
        votes[frame] = int(is_near)
    return votes if sum(votes.values()) == 1 else {"world": 0, "lidar": 0}


def _objects_of(moments: Sequence[_Moment], frame: ObjectFrame) -> tuple[RecordedBoxes, RecordedBoxes, list[str]]:
    """Annotated objects in the world, each once, and annotated agents."""
    truth, aside, n_elsewhere = [], [], 0
    for number, moment in enumerate(moments):
        known: dict[str, ndarray] = {}
        at = {agent.name: agent.world_from[:2, 3] for agent in moment.agents}
        for agent in moment.agents:
            for key, kind, box in zip(agent.key, agent.kind, agent.seen(frame), strict=True):
                xy_m = box[:2]
                if key in at and np.linalg.norm(xy_m - at[key]) < _ON_AGENT_M:
                    aside.append((number, -1, "agent", box, 1.0))
                    continue
                if key in known:
                    if np.linalg.norm(xy_m - known[key]) < _APART_M:
                        continue
                    n_elsewhere += 1
                known.setdefault(key, xy_m)
                truth.append((number, -1, class_of(kind), box, 1.0))
    remark = (
        f"{n_elsewhere:,} annotations have the number of an object that another agent has more than {_APART_M:g} m "
        "away: each counts as an object of its own."
    )
    return RecordedBoxes.of(truth), RecordedBoxes.of(aside), [remark] if n_elsewhere else []


def _detections(agent: _Agent, detections: Path | None, folder: Path) -> Listed:
    place = (detections or folder) / agent.path.relative_to(folder)
    beside = place.with_name(f"{place.stem}_pred.npy")
    if not beside.exists():
        return None
    box = upright(box_of_corners(array_of(beside, (None, 8, 3)), beside), beside)
    path = beside.with_name(f"{place.stem}_score.npy")
    return box, scores(array_of(path, (len(box),)), path)


def _in_world(given: Listed, agent: _Agent) -> Iterable[tuple[ndarray, float]]:
    if given is None:
        return ()
    box, score = given
    return zip(moved(box, agent.world_from), score.tolist(), strict=True)


def _about_keys(every: Sequence[_Agent]) -> list[str]:
    """A remark on files without a place for objects, and one on angles that look like radians.

    Raises
    ------
    ValueError
        In one line, if no file has one.
    """
    without = [agent.path for agent in every if not agent.has_objects]
    if len(without) == len(every):
        first_keys = list(_yaml(without[0]))[:8]
        keys = ", ".join(str(key)[:40] for key in first_keys)
        raise ValueError(
            f"{without[0]}: no annotation was found. It has no key `vehicles`, and no class with objects that have "
            f"location and extent; it has {keys}."
        )
    remarks = []
    if without:
        n = f"{len(without):,} of {len(every):,}"
        remarks.append(f"{n} files have no `vehicles`: the first is {without[0]}.")
    yaw_rad = np.concatenate([agent.box[:, 6] for agent in every])
    angles = np.unique(np.degrees(yaw_rad).round(6))
    largest = np.abs(angles).max(initial=0.0)
    if len(angles) > 3 and 1.6 < largest <= math.pi + 1e-3:
        remarks.append(f"no angle of an object is above {largest:.3g}: degrees are read. Are they radians?")
    return remarks


def _about_missing(local: dict[Path, Any], every: Sequence[_Agent]) -> list[str]:
    """A remark on agents without a file of detections, if others have one."""
    missing = [agent for agent in every if local[agent.path] is None]
    if not missing or len(missing) == len(every):
        return []
    of = listed(Counter(f"of agent {agent.name}" for agent in missing[:10_000]))
    first = missing[0].path
    return [
        f"{len(missing):,} of {len(every):,} files of detections are missing, such as {first.stem}_pred.npy of "
        f"{first.parent}: these agents count as if they detected nothing ({of})."
    ]


def _yaml(path: Path) -> dict[str, Any]:
    """A YAML file of plain data, in which no mapping has a key twice."""
    text = read_text(path)
    if len(text) > _MOST_YAML:
        raise ValueError(f"{path} has {len(text):,} characters, more than the {_MOST_YAML:,} that are read of YAML.")
    try:
        found = yaml.load(text, Loader=_Plain)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark is not None else ""
        raise ValueError(f"{path} is no plain YAML: {getattr(error, 'problem', None) or error}{where}.") from None
    except (RecursionError, ValueError, TypeError, OverflowError):
        raise ValueError(f"{path} is no plain YAML.") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path} should hold keys and values.")
    return found


class _Plain(yaml.SafeLoader):
    """Plain data without aliases, of which a small file can make a large value, and without keys twice.

    Numbers are those of YAML 1.2: `1e-05` is one, `010` is ten, and `1:30` is a text.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "it refers to another place of itself", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        found = super().construct_mapping(node, deep=deep)
        if len(found) < len(node.value):
            seen: set[Any] = set()
            for key, _ in node.value:
                if key.value in seen:
                    said = f"it has the key {str(key.value)[:40]!r} twice in one place"
                    raise yaml.constructor.ConstructorError(None, None, said, key.start_mark)
                seen.add(key.value)
        return found


_FLOAT = r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"


def _number(loader: _Plain, node: Any) -> int | float | str:
    """A number of YAML 1.2, or the text if it is none of these."""
    text = node.value
    if re.fullmatch(r"[-+]?[0-9]{1,19}", text):
        return int(text)
    if re.fullmatch(_FLOAT, text):
        return float(text)
    return float(text.lower().replace(".", "")) if re.fullmatch(r"[-+]?\.(inf|nan)", text.lower()) else text


for _tag in ("int", "float"):
    _Plain.add_constructor(f"tag:yaml.org,2002:{_tag}", _number)
_Plain.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(rf"^{_FLOAT}$"), list("-+.0123456789"))


def _pose(
    about: dict[str, Any],
    path: Path,
) -> tuple[Float[ndarray, "4 4"], bool]:
    """The LiDAR's pose in the world, and whether it is written as a matrix."""
    value = about.get("lidar_pose")
    if isinstance(value, list) and value and isinstance(value[0], list):
        return rigid(matrix(value, 4, 4, "lidar_pose", path), "lidar_pose", path), True
    x, y, z, roll, yaw, pitch = numbers(value, 6, "lidar_pose", path)
    motion = _transform(x, y, z, *np.radians([roll, yaw, pitch]))
    return rigid(motion, "lidar_pose", path), False


def _transform(x: float, y: float, z: float, roll: float, yaw: float, pitch: float) -> Float[ndarray, "4 4"]:
    """`x_to_world` of OpenCOOD."""
    c_y, s_y = math.cos(yaw), math.sin(yaw)
    c_r, s_r = math.cos(roll), math.sin(roll)
    c_p, s_p = math.cos(pitch), math.sin(pitch)
    forward = c_p * c_y, s_y * c_p, s_p
    aside = (
        c_y * s_p * s_r - s_y * c_r,
        s_y * s_p * s_r + c_y * c_r,
        -c_p * s_r,
    )
    up = (
        -c_y * s_p * c_r - s_y * s_r,
        -s_y * s_p * c_r + c_y * s_r,
        c_p * c_r,
    )
    motion = np.eye(4)
    motion[:3] = np.column_stack([forward, aside, up, (x, y, z)])
    return motion
