"""Mistakes in a class of every kind: each is one line that names the file, the line and what to do."""

import re
import tomllib
from pathlib import Path

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

    def headed(head):
        return source(good.replace(first, head))

    def begun(line):
        return headed(first + "\n    " + line)

    def called(name):
        return source(good.replace(f"def {hook}(", f"def {name}("))

    return {
        "syntax": (source(good) + "    def (", "SyntaxError"),
        "import": (HEADER + "import nowhere_at_all\n", "ModuleNotFoundError"),
        "exit at import": (HEADER + "raise SystemExit(0)\n", "SystemExit"),
        "value error at import": (HEADER + "int('x')\n", "ValueError: invalid literal"),
        "no class": (HEADER + "def mine(): pass\n", "defines no Mine"),
        "another class": (HEADER + "class Mind:\n    pass\n", "Did you mean Mind?"),
        "not a class": (HEADER + "Mine = 3\n", "Mine is no class"),
        "nothing": (source("pass"), "has no method"),
        "near name": (called(wrong), f"Did you mean {hook}?"),
        "other case": (called(hook.title()), f"Did you mean {hook}?"),
        "too few": (headed(f"def {hook}(self):"), "takes too few arguments"),
        "too many": (headed(first.replace("):", ", more, *, other=1):").replace("=None", "")), "needs more too"),
        "keyword only": (headed(first.replace("):", ", *, more):")), "by keyword"),
        "no self": (headed(first.replace("self, ", "")), "has no self"),
        "property": (headed("@property\n" + first), "is a property"),
        "attribute": (source(good.replace(f"def {hook}(", "def _other(") + f"\n{hook} = 3"), "not a method"),
        "generator": (begun("yield 1"), "is a generator"),
        "asynchronous": (headed("async " + first), "is asynchronous"),
        "params without Params": (source("def __init__(self, params, b, c, d, e):\n    pass\n" + good), "constructor"),
        "Params not named": (HEADER + PARAMS + source("def __init__(self, params):\n    pass\n" + good), "Params"),
        "Params misspelt": (source("class params:\n    pass\n" + good), "Did you mean Params?"),
        "Params no dataclass": (HEADER + "class Params:\n    a = 1\n" + own + body, "is not a dataclass"),
        "Params an instance": (HEADER + PARAMS + own.replace("= Params", "= Params()") + body, "an instance"),
        "Params untyped": (HEADER + PARAMS + "    b = 2\n" + own + body, "Params.b has no type"),
        "Params not taken": (HEADER + PARAMS + own + "    def __init__(self):\n        pass\n" + body, "not take them"),
        "Params inherited": (HEADER + PARAMS + "class More(Params):\n    b: float = 2.0\n"
                             + own.replace("= Params", "= More") + body, "adds to its base class"),
        "raises": (begun("1 / 0"), f"{hook}() raised ZeroDivisionError"),
        "exits": (begun("raise SystemExit(0)"), "which ends the program"),
        "asks": (begun("raise BaseException('a\\n\\x1b[31mb')"), "a ?[31mb"),
        "constructor raises": (source("def __init__(self):\n    self.a = {}['b']\n" + good), "KeyError"),
        "constructor exits": (source("def __init__(self):\n    exit()\n" + good), "SystemExit"),
        "hostile message": (begun("class E(Exception):\n        __str__ = None\n    raise E"), "cannot be shown"),
        "endless": (begun("f = lambda: f()\n    f()"), "RecursionError"),
        "None": (returns(kind, hook, "None"), "returned None"),
        "text": (returns(kind, hook, "'x' * 3"), "returned a str"),
        "dict": (returns(kind, hook, "{}"), "returned a dict"),
    }  # fmt: skip


def test_a_file_beside_it_is_not_imported(tmp_path):
    (tmp_path / "beside.py").touch()
    said = told(tmp_path, "metric", HEADER + "import beside\n")
    assert said.startswith("5: ") and "beside.py beside it is not imported" in said


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", general("attack"))
def test_of_any_kind(tmp_path, kind, name):
    text, says = general(kind)[name]
    assert says in told(tmp_path, kind, text)


PARTICULAR = tomllib.loads(Path(__file__).with_name("mistakes.toml").read_text(encoding="utf-8"))
"""By kind, method and what it returns instead of `it`: what is told."""
CASES = [(kind, hook, *case) for kind, hooks in PARTICULAR.items() for hook in hooks for case in hooks[hook].items()]


@pytest.mark.parametrize(("kind", "hook", "returned", "says"), CASES)
def test_what_a_method_may_not_return(tmp_path, kind, hook, returned, says):
    said = told(tmp_path, kind, returns(kind, hook, returned), ExtensionError)
    assert f" Mine: {hook}() " in said and says in said


def test_every_kind_has_twenty_mistakes_of_its_own():
    assert all(sum(map(len, PARTICULAR[kind].values())) >= 20 for kind in KINDS)
