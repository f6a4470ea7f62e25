"""Mistakes in a class of every kind: each is one line that names the file, the line and what to do."""

import re

import pytest

from cosim.door.blame import ExtensionError, Refused
from cosim.door.kinds import KINDS
from tests.cosim.door.tiny import HEADER, play

GOOD = {
    "attack": "def detections(self, listed, context):\n    return listed\n"
    "def evaluations(self, rows, detections, context):\n    return rows.evaluation, rows.visibility\n"
    "def identities(self, context):\n    return np.zeros(6, int)\n"
    "def sending(self, context):\n    return Sending.plain(6)\n"
    "def phantoms(self, seen, context):\n    return seen",
    "exporter": "def plan(self, selection):\n    return Plan.of_files([File('a.txt', lambda: b'')])",
    "metric": "def rows(self, run):\n    return [MetricRow('a.n', 1.0), MetricRow('a.n', 2.0, group='b')]",
    "policy": "def changes(self, ages):\n    return ages.age_s > 3",
    "medium": "def start(self):\n    return None\n"
    "def broadcast(self, state, kind, step, begin_s, stations, messages):\n"
    "    return state, MessageRound.of(stations, messages, np.array([1, 2]), np.array([0, 0]), latency_s=0.1)",
    "detector": "def detect(self, sweeps, seen, boxes, label, draws):\n"
    "    r = np.arange(6)\n    a = seen.actor\n"
    "    return Reports.of_actors(seen, r, label[a], boxes.take(a), np.full(6, 0.5))",
    "driver": "def commands(self, state, world, beliefs, dt_s):\n"
    "    return state, SpeedCommands(world.actor[:2], np.array([3.0, 4.0]))",
    "trust": "def open_step(self, step, pseudonyms, observer_row, detection_index, score):\n    self.step = step\n"
    "def add_evaluations(self, received):\n    self.rows = received.rows()\n"
    "def scores(self, now_step=None):\n"
    "    n = np.array([1, 2, 3])\n"
    "    return TrustScores.of(self.step, 0 * n, n, n / 4, newest_step=n)\n"
    "def score_objects(self, reports):\n    return np.array([0.0, 1.0])",
}
"""Methods of a class without mistakes."""


def source(methods):
    """A file with a class `Mine`; it begins in line 5, its methods in line 6."""
    return HEADER + "class Mine:\n" + "".join(f"    {line}\n" for line in methods.split("\n"))


def returns(kind, hook, expression):
    """A class whose method returns something else; `it` is what it should have returned."""
    given = ", ".join(KINDS[kind].hooks[hook].parameters)
    return source(GOOD[kind]).replace("class Mine:", "class Good:") + (
        f"class Mine(Good):\n    def {hook}(self, {given}):\n        it = super().{hook}({given})\n"
        f"        def got(**c): return replace(it[1], receptions=replace(it[1].receptions, **c))\n"
        f"        def framed(**c): return replace(it[1], frames=replace(it[1].frames, **c))\n"
        f"        return {expression}\n"
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_class_without_mistakes_passes(tmp_path, kind):
    path = tmp_path / "mine.py"
    path.write_text(source(GOOD[kind]))
    assert play(path, kind)


def told(tmp_path, kind, text, error=(ExtensionError, Refused)):
    """What is said of a class: one line that begins with file and line."""
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(error) as raised:
        play(path, kind)
    said = str(raised.value)
    assert re.match(rf"{path}:[1-9]\d*: ", said) and said.isprintable() and said.endswith(".")
    return said.removeprefix(f"{path}:")


METHOD = {kind: next(iter(hooks.hooks)) for kind, hooks in KINDS.items()} | {"medium": "broadcast", "trust": "scores"}
PARAMS = "@dataclass(frozen=True)\nclass Params:\n    a: float = 1.0\n"


def general(kind):
    """Mistakes that a class of any kind can have: text of the file, and what is told of it."""
    hook, good = METHOD[kind], GOOD[kind]
    line = re.search(rf"def {hook}\((.*)\):", good)
    first = line[0]
    wrong = hook[:-1] if hook.endswith("s") else hook + "s"
    own = "class Mine:\n    Params = Params\n"
    body = "".join(f"    {row}\n" for row in good.split("\n"))
    return {
        "syntax": (source(good) + "    def (", "SyntaxError"),
        "import": (HEADER + "import nowhere_at_all\n", "ModuleNotFoundError"),
        "exit at import": (HEADER + "raise SystemExit(0)\n", "SystemExit"),
        "value error at import": (HEADER + "int('x')\n", "ValueError: invalid literal"),
        "no class": (HEADER + "def mine(): pass\n", "defines no Mine"),
        "another class": (HEADER + "class Mind:\n    pass\n", "Did you mean Mind?"),
        "not a class": (HEADER + "Mine = 3\n", "Mine is no class"),
        "nothing": (source("pass"), "has no method"),
        "near name": (source(good.replace(f"def {hook}(", f"def {wrong}(")), f"Did you mean {hook}?"),
        "other case": (source(good.replace(f"def {hook}(", f"def {hook.title()}(")), f"Did you mean {hook}?"),
        "too few": (source(good.replace(first, f"def {hook}(self):")), "takes too few arguments"),
        "too many": (source(good.replace(first, first.replace("):", ", more, *, other=1):")
                     .replace("=None", ""))), "needs more too"),
        "keyword only": (source(good.replace(first, first.replace("):", ", *, more):"))), "by keyword"),
        "no self": (source(good.replace(first, first.replace("self, ", ""))), "has no self"),
        "property": (source(good.replace(first, "@property\n" + first)), "is a property"),
        "attribute": (source(good.replace(f"def {hook}(", "def _other(") + f"\n{hook} = 3"), "not a method"),
        "generator": (source(good.replace(first, first + "\n    yield 1")), "is a generator"),
        "asynchronous": (source(good.replace(first, "async " + first)), "is asynchronous"),
        "params without Params": (source("def __init__(self, params, b, c, d, e):\n    pass\n" + good), "constructor"),
        "Params not named": (HEADER + PARAMS + source("def __init__(self, params):\n    pass\n" + good), "Params"),
        "Params misspelt": (source("class params:\n    pass\n" + good), "Did you mean Params?"),
        "Params no dataclass": (HEADER + "class Params:\n    a = 1\n" + own + body, "is not a dataclass"),
        "Params an instance": (HEADER + PARAMS + own.replace("= Params", "= Params()") + body, "an instance"),
        "Params untyped": (HEADER + PARAMS + "    b = 2\n" + own + body, "Params.b has no type"),
        "Params not taken": (HEADER + PARAMS + own + "    def __init__(self):\n        pass\n" + body, "not take them"),
        "Params inherited": (HEADER + PARAMS + "class More(Params):\n    b: float = 2.0\n"
                             + own.replace("= Params", "= More") + body, "adds to its base class"),
        "raises": (source(good.replace(first, first + "\n    1 / 0")), f"{hook}() raised ZeroDivisionError"),
        "exits": (source(good.replace(first, first + "\n    raise SystemExit(0)")), "which ends the program"),
        "asks": (source(good.replace(first, first + "\n    raise BaseException('a\\n\\x1b[31mb')")), "a ?[31mb"),
        "constructor raises": (source("def __init__(self):\n    self.a = {}['b']\n" + good), "KeyError"),
        "constructor exits": (source("def __init__(self):\n    exit()\n" + good), "SystemExit"),
        "hostile message": (source(good.replace(first, first + "\n    class E(Exception):\n        __str__ = None"
                                                "\n    raise E")), "cannot be shown"),
        "endless": (source(good.replace(first, first + "\n    f = lambda: f()\n    f()")), "RecursionError"),
        "None": (returns(kind, hook, "None"), "returned None"),
        "text": (returns(kind, hook, "'x' * 3"), "returned a str"),
        "dict": (returns(kind, hook, "{}"), "returned a dict"),
    }  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", general("attack"))
def test_of_any_kind(tmp_path, kind, name):
    text, says = general(kind)[name]
    assert says in told(tmp_path, kind, text)


PARTICULAR = {
    "attack": {
        ("detections", "listed.boxes"): "returned a Boxes, but a Detections (",
        ("detections", "listed.take(np.arange(5))"): "left out detections of observer 5, but every detection",
        ("detections", "listed.take(np.arange(3, 6))"): "left out detections of observer 0",
        ("detections", "replace(it, score=it.score * 0.5)"): "changed detections of other vehicles",
        ("detections", "replace(it, score=list(it.score))"): "score as a list of 6",
        ("detections", "replace(it, score=it.score[:4])"): "of shape (6,) (",
        ("detections", "replace(it, transmitted=it.transmitted * 1)"): "an array of bools",
        ("detections", "replace(it, observer=it.observer + 9)"): "returned observer[0] = 9",
        ("detections", "replace(it, origin=it.origin + 7)"): "origin[0] = 8",
        ("detections", "replace(it, target=it.target - 9)"): "target[0] = -9",
        ("detections", "replace(it, identity=it.identity + 300)"): "identity[0] = 300",
        ("detections", "replace(it, label=it.label * 1.0)"): "an array of integers",
        ("detections", "replace(it, boxes=3)"): "boxes as 3",
        ("detections", "replace(it, boxes=it.boxes.take(np.arange(2)))"): "boxes.xyz_m as an array of float64",
        ("detections", "context.world.speed_mps.__setitem__(0, 9)"): "changed its argument context.world.speed_mps",
        ("detections", "it.boxes.xyz_m.__iadd__(3)"): "changed its argument listed.boxes.xyz_m in place",
        ("detections", "(it, 3)"): "returned a tuple of 2",
        ("phantoms", "replace(seen, score=seen.score * 0.5)"): "changed rows of seen",
        ("phantoms", "seen.take(np.arange(5))"): "changed rows of seen",
        ("phantoms", "fabricated(seen, np.ones(1, int), np.zeros(1), seen.boxes.take([1]), np.ones(1), np.array([4]))"):
            "target[2] = 4",
        ("phantoms", "fabricated(seen, np.ones(1, int), np.zeros(1), seen.boxes.take([1]), np.full(1, 2.0))"):
            "of a phantom that a message can contain",
        ("evaluations", "rows.evaluation"): "a tuple (evaluation, visibility) is expected",
        ("evaluations", "(rows.evaluation[:3], rows.visibility)"): "evaluation as an array of float64 of shape (3,)",
        ("evaluations", "(rows.evaluation - 9, rows.visibility)"): "evaluation[0] = -8.5",
        ("evaluations", "(rows.evaluation, rows.visibility * np.nan)"): "visibility[0] = nan",
        ("evaluations", "(-rows.evaluation, rows.visibility)"): "changed the evaluation of other vehicles",
        ("evaluations", "(1, 1)"): "evaluation as 1",
        ("identities", "3"): "returned 3, but an array of integers of shape (6,) (",
        ("identities", "np.full(6, 400)"): "identities[0] = 400",
        ("identities", "np.full(6, 0.5)"): "returned an array of float64",
        ("identities", "np.full(3, 1)"): "of shape (3,)",
        ("sending", "np.zeros(6)"): "a Sending (",
        ("sending", "Sending.plain(3)"): "delay_s as an array of float64 of shape (3,)",
        ("sending", "replace(Sending.plain(6), delay_s=np.full(6, -1.0))"): "delay_s[0] = -1",
        ("sending", "replace(Sending.plain(6), delay_s=np.full(6, 1.0))"): "0 for actors that do not attack",
        ("sending", "replace(Sending.plain(6), n_copies=np.full(6, 0.5))"): "n_copies as an array of float64",
        ("sending", "replace(Sending.plain(6), n_reports=np.full(6, 10**7))"): "n_reports[0] = 10000000",
    },
    "exporter": {
        ("plan", "[it]"): "returned a list of 1, but a Plan (",
        ("plan", "it.units"): "returned a tuple of 1",
        ("plan", "File('a', lambda: b'')"): "returned a File",
        ("plan", "iter([])"): "returned a list_iterator",
        ("plan", "3"): "returned 3",
        ("plan", "True"): "returned True",
        ("plan", "Plan"): "returned a type",
        ("plan", "Plan()"): "raised TypeError",
        ("plan", "Plan.of_files(3)"): "raised TypeError",
        ("plan", "replace(it, units=list(it.units))"): "units as a list of 1, but a tuple of Unit is expected",
        ("plan", "replace(it, units=('a',))"): "units as a tuple of 1",
        ("plan", "replace(it, units=None)"): "units as None",
        ("plan", "replace(it, units=it.units * 2)"): "several units called 'files'",
        ("plan", "replace(it, units=(replace(it.units[0], name=3),))"): "a unit called 3",
        ("plan", "replace(it, units=(replace(it.units[0], name=''),))"): "a unit called ''",
        ("plan", "replace(it, units=(replace(it.units[0], name='a\\nb'),))"): "a name in one line is expected",
        ("plan", "replace(it, units=(replace(it.units[0], files=[]),))"): "as a list of 0, but a function is expected",
        ("plan", "replace(it, n_sweeps=-1)"): "n_sweeps as -1",
        ("plan", "replace(it, n_sweeps=None)"): "n_sweeps as None",
        ("plan", "replace(it, bytes_per_point='16')"): "bytes_per_point as a str",
        ("plan", "replace(it, text_bytes=float('nan'))"): "text_bytes as nan",
        ("plan", "object.__new__(Plan)"): "cannot be read: AttributeError",
        ("plan", "selection.nothing"): "AttributeError",
    },
    "metric": {
        ("rows", "3.0"): "returned 3.0, but a list of MetricRow is expected",
        ("rows", "it[0]"): "returned row 0 as a str",
        ("rows", "iter(it)"): "returned a list_iterator",
        ("rows", "np.ones(3)"): "an array of float64",
        ("rows", "[3.0]"): "row 0 as 3.0, but a MetricRow(metric=..., value=...) is expected",
        ("rows", "[None]"): "row 0 as None",
        ("rows", "[('a.n', 1.0)]"): "row 0 as a tuple of 2",
        ("rows", "[{'metric': 'a.n'}]"): "row 0 as a dict",
        ("rows", "[it]"): "row 0 as a list of 2",
        ("rows", "it + it[:1]"): "metric 'a.n' twice for group ''",
        ("rows", "[MetricRow('a', '1')]"): "value = '1' in row 0, but a number of at most 1e+100 in size (NaN",
        ("rows", "[MetricRow('a', None)]"): "value = None",
        ("rows", "[MetricRow('a', True)]"): "value = True",
        ("rows", "[MetricRow('a', np.ones(2))]"): "a number of at most 1e+100 in size (NaN",
        ("rows", "[MetricRow('a', 1j)]"): "value = 1j",
        ("rows", "[MetricRow('', 1.0)]"): "with a wrong text",
        ("rows", "[MetricRow(3, 1.0)]"): "with a wrong text",
        ("rows", "[MetricRow('a', 1.0, group=3)]"): "with a wrong text",
        ("rows", "[MetricRow('a', 1.0, unit=None)]"): "with a wrong text",
        ("rows", "[MetricRow('a', 1.0, label=1)]"): "with a wrong text",
        ("rows", "[MetricRow('a')]"): "raised TypeError",
        ("rows", "run.nothing"): "AttributeError",
    },
    "policy": {
        ("changes", "[True]"): "returned a list of 1, but an array of bools of shape (6,) (",
        ("changes", "True"): "returned True",
        ("changes", "np.array([True])"): "an array of bool of shape (1,)",
        ("changes", "it[:5]"): "of shape (5,)",
        ("changes", "it[:, None]"): "of shape (6, 1)",
        ("changes", "np.flatnonzero(it)"): "an array of int64",
        ("changes", "it * 1"): "an array of int64",
        ("changes", "it * 1.0"): "an array of float64",
        ("changes", "ages.age_s"): "an array of float64",
        ("changes", "it.astype(object)"): "an array of object",
        ("changes", "list(it)"): "a list of 6",
        ("changes", "np.array(True)"): "of shape ()",
        ("changes", "self"): "returned a Mine",
        ("changes", "ages"): "returned a PseudonymAges",
        ("changes", "(it, it)"): "returned a tuple of 2",
        ("changes", "ages.age_s.fill(0)"): "changed its argument ages.age_s",
        ("changes", "ages.nothing > 3"): "AttributeError",
        ("changes", "it > np.arange(3)"): "ValueError",
        ("changes", "np.ma.masked_array(it, it)"): "returned a MaskedArray",
        ("changes", "{0: True}"): "returned a dict",
        ("changes", "iter(it)"): "an iterator",
    },
    "medium": {
        ("broadcast", "it[1]"): "a tuple (state, MessageRound) is expected",
        ("broadcast", "(it[1], state)"): "a tuple (state, MessageRound) is expected",
        ("broadcast", "(state, None)"): "returned (None, None)",
        ("broadcast", "(state, replace(it[1], station=it[1].station + 1))"): "the given messages.station is expected",
        ("broadcast", "(state, replace(it[1], receptions=None))"): "receptions as None",
        ("broadcast", "(state, replace(it[1], frames=()))"): "frames as a tuple of 0",
        ("broadcast", "MessageRound.of(stations, messages, np.array([9]), np.array([0]))"): "receiver is not one row",
        ("broadcast", "(state, got(receiver=np.array([1, 9])))"): "receptions.receiver[1] = 9, but 0 to 5 is expected",
        ("broadcast", "(state, got(message=np.array([0, -1])))"): "receptions.message[1] = -1",
        ("broadcast", "(state, got(receiver=np.array([0, 2])))"): "another station than the sender",
        ("broadcast", "(state, got(message=np.array([5, 5])))"): "of length_bytes > 0, is expected",
        ("broadcast", "(state, got(receiver=np.array([2, 1])))"): "not ascending by receptions.receiver, message",
        ("broadcast", "(state, got(receiver=np.array([1, 1])))"): "not ascending",
        ("broadcast", "(state, got(latency_s=np.array([0.1, -0.1])))"): "ValueError: a reception with a negative delay",
        ("broadcast", "(state, got(latency_s=np.array([0.1, np.nan])))"): "a reception with a negative delay",
        ("broadcast", "(state, got(access_delay_s=np.array([0.0, 0.2])))"): "no message is received before",
        ("broadcast", "(state, got(latency_s=np.array([0.1, 3.0])))"): "latency_s[1] = 3.0, but 0 to 0.4 is expected",
        ("broadcast", "(state, got(generation_offset_s=np.array([0.0, 0.39])))"): "received_s[1] = 0.49",
        ("broadcast", "(state, got(hops=np.array([0, 1])))"): "receptions.hops[0] = 0",
        ("broadcast", "(state, got(hops=np.array([1])))"): "receptions.hops as an array of int64 of shape (1,)",
        ("broadcast", "(state, got(distance_m=np.array([1.0, np.inf])))"): "receptions.distance_m[1] = inf",
        ("broadcast", "(state, got(receiver=np.array([1, 3])))"): "a message whose frame has the outcome RECEIVED",
        ("broadcast", "(state, framed(outcome=np.array([1, 1])))"): "a message whose frame has the outcome RECEIVED",
        ("broadcast", "(state, framed(outcome=np.array([0, 9])))"): "frames.outcome[1] = 9",
        ("broadcast", "(state, framed(los_state=np.array([0.5, 0.5])))"): "frames.los_state as an array of float64",
        ("broadcast", "(state, framed(n_transmissions=np.ones(2, int)))"): "frames.n_transmissions as an array",
        ("broadcast", "(state, framed(sent_bytes=float('nan')))"): "frames.sent_bytes as nan",
        ("broadcast", "(state, framed(n_relayed=None))"): "frames.n_relayed as None",
        ("broadcast", "(state, framed(cbr=np.full(6, 2.0)))"): "frames.cbr[0] = 2.0",
        ("broadcast", "(state, framed(cbr=0.5))"): "frames.cbr as 0.5",
        ("broadcast", "messages.length_bytes.fill(9)"): "changed its argument messages.length_bytes",
    },
    "detector": {
        ("detect", "[it]"): "returned a list of 1, but a Reports (",
        ("detect", "boxes"): "returned a Boxes",
        ("detect", "replace(it, boxes=None)"): "returned boxes as None",
        ("detect", "replace(it, observer=it.observer + 1)"): "observer[3] = 2 and 2 more like it, but 0 to 1 is",
        ("detect", "replace(it, observer=it.observer - 1)"): "observer[0] = -1",
        ("detect", "replace(it, observer=it.observer * 1.0)"): "observer as an array of float64",
        ("detect", "replace(it, actor=it.actor + 9)"): "actor[0] = 10",
        ("detect", "replace(it, actor=it.actor[:2])"): "actor as an array of int32 of shape (2,)",
        ("detect", "replace(it, label=it.label + 9)"): "label[0] = 9",
        ("detect", "replace(it, label='car')"): "label as a str",
        ("detect", "replace(it, label=np.array(['car'] * 6))"): "label as an array of <U3",
        ("detect", "replace(it, score=it.score * 100)"): "score[0] = 50.0 and 5 more like it, but 0 to 1 is expected",
        ("detect", "replace(it, score=it.score - 1)"): "score[0] = -0.5",
        ("detect", "replace(it, score=it.score * np.nan)"): "score[0] = nan",
        ("detect", "replace(it, score=0.5)"): "score as 0.5",
        ("detect", "replace(it, score=np.ones(6, int))"): "an array of floats of shape (6,) (",
        ("detect", "replace(it, score=it.score[:, None])"): "of shape (6, 1)",
        ("detect", "replace(it, is_false_positive=np.zeros(6))"): "is_false_positive as an array of float64",
        ("detect", "replace(it, boxes=it.boxes.take(np.arange(2)))"): "of shape (2,) (",
        ("detect", "replace(it, boxes=replace(it.boxes, xyz_m=it.boxes.xyz_m * np.nan))"): "is not finite",
        ("detect", "replace(it, boxes=replace(it.boxes, lwh_m=-it.boxes.lwh_m))"): "must be positive",
        ("detect", "replace(it, boxes=replace(it.boxes, xyz_m=it.boxes.xyz_m * 1e9))"): "boxes.xyz_m[0]",
        ("detect", "boxes.xyz_m.fill(3)"): "changed its argument boxes.xyz_m in place",
        ("detect", "seen.n_returns.sort() or label.fill(2)"): "changed its argument label",
    },
    "driver": {
        ("commands", "it[1]"): "a tuple (state, SpeedCommands) is expected",
        ("commands", "(it[1], state)"): "a tuple (state, SpeedCommands) is expected",
        ("commands", "(state, None)"): "returned (None, None)",
        ("commands", "(state, {})"): "(None, a dict)",
        ("commands", "(state, [], [])"): "a tuple of 3",
        ("commands", "(state, SpeedCommands(np.arange(2), np.ones(2)))"): "actor[0] = 0 and 1 more like it",
        ("commands", "(state, SpeedCommands(world.actor[::-1], np.ones(6)))"): "not ascending by actor",
        ("commands", "(state, SpeedCommands(world.actor[[0, 0]], np.ones(2)))"): "not ascending by actor",
        ("commands", "(state, SpeedCommands(world.actor[-1:], np.ones(1)))"): "actor[0] = 15, but a vehicle",
        ("commands", "(state, SpeedCommands(world.actor[:2], np.ones(3)))"): "speed_mps as an array of float64",
        ("commands", "(state, SpeedCommands(world.actor[:2], 3.0))"): "speed_mps as 3.0",
        ("commands", "(state, SpeedCommands([10], np.ones(1)))"): "actor as a list of 1",
        ("commands", "(state, SpeedCommands(world.actor[:2] * 1.0, np.ones(2)))"): "actor as an array of float64",
        ("commands", "(state, SpeedCommands(world.actor[:2], np.array([3.0, np.nan])))"): "speed_mps[1] = nan",
        ("commands", "(state, SpeedCommands(world.actor[:2], np.array([-3.0, 1.0])))"): "speed_mps[0] = -3.0",
        ("commands", "(state, SpeedCommands(world.actor[:2], np.array([np.inf, 1.0])))"): "speed_mps[0] = inf",
        ("commands", "(state, SpeedCommands(world.actor[:2], np.array([3, 4])))"): "an array of floats",
        ("commands", "(state, SpeedCommands(world.actor[:2], np.ones((2, 1))))"): "of shape (2, 1)",
        ("commands", "(state, replace(it[1], reasons=3))"): "reasons as 3",
        ("commands", "(state, replace(it[1], reasons=Reasons(*[np.zeros(2, int)] * 4)))"): "reasons.gap_m",
        ("commands", "(state, replace(it[1], reasons=Reasons(*[np.zeros(1, int)] * 4)))"): "reasons.source_step",
        ("commands", "world.speed_mps.fill(0)"): "changed its argument world.speed_mps",
        ("commands", "beliefs.score.fill(0)"): "changed its argument beliefs.score",
    },
    "trust": {
        ("scores", "object.__new__(TrustScores)"): "returned what cannot be read: AttributeError",
        ("scores", "it.trust"): "a TrustScores (",
        ("scores", "replace(it, trust=it.trust * np.nan)"): "trust[0] = nan of subject 1 and 2 more like it",
        ("scores", "replace(it, trust=it.trust * 2)"): "trust[2] = 1.5 of subject 3, but 0 to 1 is expected",
        ("scores", "replace(it, trust=it.trust[:2])"): "trust as an array of float64 of shape (2,)",
        ("scores", "replace(it, weight=1.0)"): "weight as 1.0",
        ("scores", "replace(it, weight=it.weight * np.inf)"): "weight[0] = inf",
        ("scores", "replace(it, uncertainty=np.array([np.nan, 0.5, 0.5]))"): "uncertainty[0] = nan",
        ("scores", "replace(it, uncertainty=it.trust - 1)"): "uncertainty[0] = -0.75",
        ("scores", "replace(it, n_evaluations=-it.n_evaluations)"): "n_evaluations[0] = -1",
        ("scores", "replace(it, n_evaluations=it.n_evaluations * 0.5)"): "n_evaluations as an array of float64",
        ("scores", "replace(it, n_evaluations=it.n_evaluations * 0)"): "is_evaluated[0] = True",
        ("scores", "replace(it, is_evaluated=it.is_evaluated * 1)"): "is_evaluated as an array of int64",
        ("scores", "replace(it, n_evaluators=it.n_evaluations + 1)"): "0 to n_evaluations is expected",
        ("scores", "replace(it, newest_step=it.newest_step + 9)"): "newest_step[0] = 10 of subject 1",
        ("scores", "replace(it, oldest_step=it.newest_step + 1)"): "not later than newest_step is expected",
        ("scores", "replace(it, oldest_step=it.oldest_step - 5)"): "oldest_step[0] = -6",
        ("scores", "replace(it, newest_evaluation_step=it.newest_step + 9)"): "newest_evaluation_step[0] = 10",
        ("scores", "replace(it, oldest_evaluation_step=it.newest_step + 1)"): "not later than newest_evaluation_step",
        ("scores", "replace(it, newest_step=it.newest_step * 1.0)"): "newest_step as an array of float64",
        ("scores", "replace(it, step=99)"): "step = 99, but the step of the call, 5, is expected",
        ("scores", "replace(it, step=None)"): "step = None",
        ("scores", "replace(it, subject=it.subject[::-1])"): "not ascending by holder, subject",
        ("scores", "replace(it, subject=it.subject * 0)"): "not ascending by holder, subject",
        ("scores", "replace(it, subject=it.subject - 9)"): "subject[0] = -8",
        ("scores", "replace(it, holder=it.holder + 2**40)"): "holder[0] = 1099511627776",
        ("open_step", "{}"): "open_step() returned a dict, but no result",
        ("add_evaluations", "received"): "add_evaluations() returned a ReceivedEvaluations, but no result",
        ("add_evaluations", "received.messages.visibility.fill(0)"): "changed its argument received.messages.visib",
        ("score_objects", "0.5"): "returned 0.5, but an array of floats of shape (2,) (",
        ("score_objects", "np.ones(3)"): "of shape (3,)",
        ("score_objects", "np.array([0.5, np.nan])"): "scores[1] = nan",
        ("score_objects", "np.array([0.5, 1.5])"): "scores[1] = 1.5",
        ("score_objects", "np.array([True, False])"): "an array of bool",
    },
}  # fmt: skip
"""By kind, method and what it returns instead of `it`: what is told."""
CASES = [(kind, *case) for kind, cases in PARTICULAR.items() for case in cases]


@pytest.mark.parametrize(("kind", "hook", "returned"), CASES)
def test_what_a_method_may_not_return(tmp_path, kind, hook, returned):
    said = told(tmp_path, kind, returns(kind, hook, returned), ExtensionError)
    assert f" Mine: {hook}() " in said and PARTICULAR[kind][hook, returned] in said


def test_every_kind_has_twenty_mistakes_of_its_own():
    assert all(len(PARTICULAR[kind]) >= 20 for kind in KINDS)
