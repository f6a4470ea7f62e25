"""Classes that run, return what their interfaces ask for, and each break one law."""

import itertools
import sys
from dataclasses import replace

import numpy as np

from cosim.extend import (
    SENSED,
    SERVER,
    File,
    MessageRound,
    MetricRow,
    PairIndex,
    Plan,
    Reports,
    Sending,
    SpeedCommands,
    TrustScores,
    draws,
    with_rows,
)


class Counting:
    """A trust model that keeps every law: the share of positive evidence."""

    def __init__(self, params, dt_s):
        self.step, self.pairs, self.sums = 0, PairIndex(), np.zeros((0, 2))

    def open_step(self, step, pseudonyms, observer_row, detection_index, score):
        self.step = step

    def add_evaluations(self, received):
        rows = received.rows()
        at = self.pairs.rows(rows.holder, rows.observer)
        self.sums = with_rows(self.sums, len(self.pairs))
        np.add.at(self.sums, at, np.column_stack([rows.pos, rows.neg]))

    def scores(self, now_step=None):
        holder, subject, at = self.pairs.sorted()
        pos, neg = self.sums[at].T
        now = self.step if now_step is None else now_step
        return TrustScores.of(
            now, holder, subject, (pos + 1) / (pos + neg + 2), newest_step=np.full(len(at), self.step)
        )


class LastWins(Counting):
    """What arrives later weighs more: the order of messages matters."""

    def add_evaluations(self, received):
        self.sums *= 0.9
        super().add_evaluations(received)


class Shared(Counting):
    """All holders share the evidence of all."""

    def add_evaluations(self, received):
        everyone = np.unique(np.concatenate([self.pairs.sorted()[0], received.holder]))
        for holder in everyone:
            super().add_evaluations(replace(received, holder=np.full(len(received.holder), holder)))


class Forgetful(Counting):
    """Asking it for scores makes it forget."""

    def scores(self, now_step=None):
        found = super().scores(now_step)
        self.sums = 0.5 * self.sums
        return found


class KnowsNumbers(Counting):
    """It trusts those with low pseudonyms more."""

    def scores(self, now_step=None):
        found = super().scores(now_step)
        return replace(found, trust=found.trust / (1 + found.subject))


class Impatient(Counting):
    """It does not take evaluations of earlier steps than it has seen."""

    newest = 0

    def add_evaluations(self, received):
        if received.messages.step < self.newest:
            raise ValueError("too late")
        self.newest = received.messages.step
        super().add_evaluations(received)


class Ahead(Counting):
    """Its evidence is of the step that comes."""

    def scores(self, now_step=None):
        found = super().scores(now_step)
        return replace(found, newest_step=found.newest_step + 1)


class Silent(Counting):
    """It has no value, as it takes no evaluation."""

    def add_evaluations(self, received):
        pass


class OfTheServer(Counting):
    """It keeps every law: the server's values count messages, and rest on no evaluation."""

    def open_step(self, step, pseudonyms, observer_row, detection_index, score):
        super().open_step(step, pseudonyms, observer_row, detection_index, score)
        at = self.pairs.rows(np.full(len(pseudonyms), SERVER), pseudonyms)
        self.sums = with_rows(self.sums, len(self.pairs))
        self.sums[at, 0] += 1

    def add_evaluations(self, received):
        pass


class Peeks(Counting):
    """It looks up in the callers' variables who attacks."""

    def scores(self, now_step=None):
        found, frame = super().scores(now_step), sys._getframe()
        while frame is not None and "world" not in frame.f_locals:
            frame = frame.f_back
        if frame is None:
            return found
        world = frame.f_locals["world"]
        attacks = np.isin(found.subject, world.actor[world.attack > 0])
        return replace(found, trust=np.where(attacks, 0.0, found.trust))


class Unkept(Counting):
    """Its state cannot be written to a checkpoint."""

    def __init__(self, params, dt_s):
        super().__init__(params, dt_s)
        self.numbers = itertools.count()


class DeniesTheTrue:
    """An attack that denies what detectors made, and spares what others fabricated."""

    def evaluations(self, rows, detections, context):
        true = detections.origin[rows.detection] == SENSED
        lies = context.attacker[rows.evaluator] & true
        return np.where(lies, -1.0, rows.evaluation), rows.visibility


class SparesAttackers:
    """An attack that knows who else attacks."""

    def evaluations(self, rows, detections, context):
        honest = context.world.attack[detections.observer[rows.detection]] == 0
        lies = context.attacker[rows.evaluator] & honest
        return np.where(lies, -1.0, rows.evaluation), rows.visibility


class RowDelays:
    """An attack that delays messages by the row of their sender."""

    def sending(self, context):
        n = len(context.world)
        delay_s = np.where(context.attacker, 0.01 * (np.arange(n) % 5), 0.0)
        return replace(Sending.plain(n), delay_s=delay_s)


class RandomAttack:
    """An attack that draws from a generator of its own."""

    def __init__(self):
        self.generator = np.random.default_rng(4)

    def evaluations(self, rows, detections, context):
        drawn = self.generator.uniform(-1, 1, len(rows.evaluation))
        return np.where(context.attacker[rows.evaluator], drawn, rows.evaluation), rows.visibility


class OldestChanges:
    """A policy in which the oldest pseudonyms of all change: who else is there matters."""

    def changes(self, ages):
        return (ages.distance_m >= 20.0) & (ages.distance_m >= ages.distance_m.max(initial=0.0) - 1.0)


class RowChanges:
    """A policy in which every third vehicle changes, by row."""

    def changes(self, ages):
        return (np.arange(len(ages.age_s)) % 3 == 0) & (ages.age_s > 2.0)


class OwnGenerator:
    """A medium that draws from a generator of its own."""

    def __init__(self, params, round_s, seed, los):
        self.generator = np.random.default_rng(seed)

    def start(self):
        return None

    def lost(self, receiver, message):
        return self.generator.random(len(receiver)) < 0.2

    def broadcast(self, state, kind, step, begin_s, stations, messages):
        return state, _round(stations, messages, self.lost)


class GeneratorInState(OwnGenerator):
    """The same, with the generator in the state: repeatable, but each message's draw depends on all before it."""

    def start(self):
        return np.arange(2)

    def broadcast(self, state, kind, step, begin_s, stations, messages):
        generator = np.random.default_rng(state)
        happened = _round(stations, messages, lambda receiver, _: generator.random(len(receiver)) < 0.2)
        return state + 1, happened


class NoSeed(OwnGenerator):
    """A medium that is different in every run."""

    def __init__(self, params, round_s, seed, los):
        self.generator = np.random.default_rng()


def _round(stations, messages, lost):
    near = np.linalg.norm(stations.xyz_m[:, None] - stations.xyz_m[messages.station][None], axis=2) <= 300.0
    near[messages.station, np.arange(len(messages))] = False
    receiver, message = np.nonzero(near & (messages.length_bytes > 0))
    got = ~lost(receiver, message)
    return MessageRound.of(stations, messages, receiver[got], message[got], latency_s=0.001)


class NoisyRows:
    """A detector whose noise follows the order of rows."""

    def detect(self, sweeps, seen, boxes, label, draws):
        rows = np.flatnonzero(seen.n_returns >= 20)
        actor = seen.actor[rows]
        score = np.random.default_rng(int(draws.observer_step[0] % 1000)).uniform(0.5, 1.0, len(rows))
        return Reports.of_actors(seen, rows, label[actor], boxes.take(actor), score)


class HiddenState:
    """A driver that remembers in itself instead of in its state."""

    def __init__(self):
        self.n_steps = 0

    def commands(self, state, world, beliefs, dt_s):
        self.n_steps += 1
        rows = np.flatnonzero(world.equipped & (world.speed_mps > 0))
        return None, SpeedCommands(world.actor[rows].astype(int), np.full(len(rows), 1.0 + self.n_steps // 2))


class KeepsAFunction:
    """A driver whose state is no data."""

    def commands(self, state, world, beliefs, dt_s):
        return (lambda: world.step), SpeedCommands.none()


class KnowsAttackers:
    """A driver that brakes where attackers are on the road."""

    def commands(self, state, world, beliefs, dt_s):
        rows = np.flatnonzero(world.equipped & (world.attack == 0))
        return None, SpeedCommands(world.actor[rows].astype(int), np.ones(len(rows)))


class RandomFile:
    """An exporter that writes something else each time."""

    TABLES = ("actors",)

    def plan(self, selection):
        noise = np.random.default_rng().random()
        return Plan.of_files([File("noise.txt", lambda: f"{noise}".encode())])


class LastOnDisk:
    """A metric of the row that happens to be the last."""

    def rows(self, run):
        last = [part for part in run.parts("actors", ["step", "x_m"])][-1]
        return [MetricRow("last.n", float(len(last)))]


class Fails:
    """A metric with a mistake."""

    def rows(self, run):
        return [MetricRow("x", 1 / 0)]


class KeyedMedium:
    """A medium without a mistake."""

    def __init__(self, params, round_s, seed, los):
        self.seed = seed

    def start(self):
        return None

    def broadcast(self, state, kind, step, begin_s, stations, messages):
        def lost(receiver, message):
            names = stations.key[receiver], messages.keys(stations)[message], np.full(len(message), kind)
            return draws(self.seed, step, names)[:, 0] <= 0.2

        return state, _round(stations, messages, lost)
