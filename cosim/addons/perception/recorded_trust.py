"""Trust in recorded data sets: agents evaluate each other's boxes by their own detections and clouds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.perception.clouds import points_in, points_of
from cosim.addons.perception.recorded import Recorded, RecordedBoxes, moved
from cosim.base.ragged import place_in_group, ptr_of
from sensors import boxes as geometry
from trust.evaluation import evaluate
from trust.fusion import SensorEvidence, fuse
from trust.matching import match
from trust.models.trupercept import TruPercept
from trust.params import TrustParams, eta_of
from trust.tables import (
    SERVER,
    FusionInput,
    ObjectLists,
    ReceivedEvaluations,
    SenderTrust,
    SentDetections,
    as_messages,
)

PARAMS = TrustParams(method="trupercept_1", freshness_s="off")


@dataclass(frozen=True, slots=True)
class Trusted:
    """Trust in the agents after the last frame, and the ego's objects fused with the trust of each moment."""

    agents: pd.DataFrame
    """agent, n_frames in which it cooperates, n_evaluations of its boxes by others, trust."""
    fused: RecordedBoxes
    n_unread: int
    """Frames left out, because the cloud of an agent is missing or cannot be read."""
    why_unread: str
    """A sentence on the first of them, if its cloud is there and cannot be read."""


def _named(scenario: str, agents: Sequence[str]) -> tuple[str, ...]:
    """Names of the agents of a scenario beside those of others."""
    return tuple(f"{scenario}/{name}" for name in agents)


def trusted(data: Recorded, cooperating: Sequence[Int[ndarray, "k"]], boxes: RecordedBoxes) -> Trusted:
    """TruPercept over the frames of a data set, in their order.

    Parameters
    ----------
    cooperating
        In each frame, numbers of the ego and of the agents that cooperate with it, ascending. The others do nothing.
    boxes
        Detections of these agents, sorted by frame and agent.

    Notes
    -----
    In each frame each of them evaluates the boxes of the others: e is the score of its own detection that matches,
    else eta; the visibility is that of the points of its own cloud in the box. A box without points is not evaluated:
    whether rays passed through it would need the sweep, not the cloud. Trust is that of one server that receives
    everything, and never expires. In several scenarios ("scenario/frame"), agents of one name are different ones, and
    have the name "scenario/agent".
    """
    scenarios = [frame.rpartition("/")[0] for frame in data.frames]
    called = data.agents
    if len(set(scenarios)) > 1:
        both = zip(scenarios, data.agents, strict=True)
        called = tuple(_named(scenario, here) for scenario, here in both)
    everyone = sorted(set().union(*called))
    numbers = {name: k for k, name in enumerate(everyone)}
    kinds = sorted(set(boxes.label.tolist()))
    label = np.array([kinds.index(name) for name in boxes.label], np.uint8)
    model = TruPercept(PARAMS, 1.0)
    chosen, scores = [np.zeros(0, int)], [np.zeros(0)]
    unread, why_unread = 0, ""
    present = dict.fromkeys(numbers, 0)
    begin = ptr_of(boxes.frame, len(data.frames))
    for frame, here in enumerate(cooperating):
        rows = np.arange(begin[frame], begin[frame + 1])
        if not len(rows):
            continue
        names = [called[frame][agent] for agent in here]
        clouds = _clouds([data.clouds[frame][agent] for agent in here])
        if isinstance(clouds, str):
            unread, why_unread = unread + 1, why_unread or clouds
            continue
        known = model.scores(frame) if frame else None
        scene = _Frame.of(boxes, rows, label, here)
        given, evidence = scene.evaluated(clouds, data.world_from[frame][here])
        who = np.array([numbers[name] for name in names])
        sent = scene.table
        model.open_step(frame, who, sent.message, sent.detection_index, sent.score)
        messages = as_messages(frame, who, given.evaluated, sent, given.own)
        everybody = np.arange(len(who))
        model.add_evaluations(ReceivedEvaluations(messages, np.full(len(who), SERVER), everybody, eta_of(PARAMS)))
        others = everybody[1:]
        trust_in: dict[int, float] = {}
        if known is not None:
            trust_in = dict(zip(known.subject.tolist(), known.trust.tolist(), strict=True))
        senders = who[1:].tolist()
        trust = np.array([trust_in.get(sender, PARAMS.default_trust) for sender in senders])
        in_others = SenderTrust(np.array([0, len(others)]), others, trust)
        found = fuse(given, in_others, evidence, np.zeros(len(rows)), PARAMS)
        chosen.append(rows[found.seed])
        scores.append(found.score)
        for name in names:
            present[name] += 1
    rows = np.concatenate(chosen)
    fused = replace(boxes.take(rows), score=np.concatenate(scores))
    final = model.scores()
    of = {one: row for row, one in enumerate(final.subject.tolist())}
    lines = []
    for name, number in numbers.items():
        n, value = 0, np.nan
        if number in of:
            row = of[number]
            n = int(final.n_evaluations[row])
            value = float(final.trust[row])
        lines.append((name, present[name], n, value))
    table = pd.DataFrame(lines, columns=["agent", "n_frames", "n_evaluations", "trust"])
    return Trusted(table, fused, unread, why_unread)


def _clouds(paths: Sequence[Path]) -> list[Float[ndarray, "n 3"]] | str:
    """The clouds of some agents of a frame; or why one cannot be read, which is empty if it is missing."""
    if not all(path.is_file() for path in paths):
        return ""
    try:
        return [points_of(path) for path in paths]
    except ValueError as error:
        return str(error)


@dataclass(frozen=True, slots=True)
class _Frame:
    """The boxes of one frame as messages, and the list of every agent: its own boxes, then the others'."""

    box: Float[ndarray, "n 7"]
    table: SentDetections
    lists: ObjectLists

    @staticmethod
    def of(boxes: RecordedBoxes, rows: Int[ndarray, "n"], label: ndarray, here: Int[ndarray, "k"]) -> "_Frame":
        message = np.searchsorted(here, boxes.agent[rows])
        index = 1 + place_in_group(message)
        score = np.clip(boxes.score[rows], 0.0, 1.0)
        table = SentDetections(message, index, label[rows], score, np.zeros(len(rows), bool))
        agent = np.arange(len(here))
        member = np.argsort(message != agent[:, None], axis=1, kind="stable")
        ptr = len(rows) * np.arange(len(here) + 1)
        lists = ObjectLists(ptr, member.ravel(), agent)
        return _Frame(boxes.box[rows], table, lists)

    def evaluated(
        self, clouds: list[Float[ndarray, "n 3"]], world_from: Float[ndarray, "k 4 4"]
    ) -> tuple[FusionInput, SensorEvidence]:
        """What the ego fuses, and the evidence of its own cloud."""
        box = self.box
        plain = geometry.Boxes(
            box[:, :3],
            box[:, 3:6],
            box[:, 6],
        )
        pairs = geometry.overlapping_pairs(plain, self.table.label, self.table.message)
        groups = match(self.lists, self.table, pairs, PARAMS)
        in_agents = [moved(box, np.linalg.inv(motion)) for motion in world_from]
        inside = np.array(list(map(points_in, clouds, in_agents)))
        lists = self.lists
        n_points = inside[lists.of_member(), lists.member]
        is_asked = np.ones(len(n_points), bool)
        made = evaluate(lists, groups, self.table, n_points, is_asked, PARAMS)
        n = int(lists.ptr[1])
        ego = ObjectLists(
            lists.ptr[:2],
            lists.member[:n],
            lists.owner[:1],
        )
        of_ego = match(ego, self.table, pairs, PARAMS)
        seeds = ego.member[of_ego.seeds()]
        every = np.ones(len(seeds), bool)
        evidence = SensorEvidence(inside[0, seeds], every, every)
        return FusionInput(ego, of_ego, self.table, lists, made, made), evidence
