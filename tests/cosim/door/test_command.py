"""`cosim check` on configs with a user's own class: one line and exit status 2 for every mistake."""

import sys

import pytest

from cosim.cli.main import main

HEADER = "from dataclasses import dataclass, field\nimport numpy as np\n"
PARAMS = HEADER + "@dataclass(frozen=True)\nclass Params:\n    {}\n"
POLICY = """class Mine:
    Params = Params
    def __init__(self, params):
        self.params = params
    def changes(self, ages):
        return ages.age_s > 3
"""
CONFIG = '[pseudonyms]\npolicy = "mine.py:Mine"\n'


@pytest.fixture
def check(tmp_path, monkeypatch, capsys):
    """Exit status, output and error output of `cosim check` with a file beside the config."""

    def run(text, config=CONFIG, *words):
        (tmp_path / "mine.py").write_text(text)
        (tmp_path / "mine.toml").write_text(config)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["cosim", *words, "check", "mine.toml"])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run


def test_parameters_are_read_and_shown(check):
    status, out, err = check(PARAMS.format("every: int = 3\n    share: float = 0.5") + POLICY, CONFIG + "every = 7\n")
    assert (status, err) == (0, "") and "every = 7" in out and "share = 0.5" in out


def test_a_class_without_parameters_passes(check):
    assert check("class Mine:\n    def changes(self, ages):\n        return ages.age_s > 3\n")[0] == 0


@pytest.mark.parametrize(
    ("text", "config", "told"),
    [
        ("", CONFIG.replace("mine.py", "nowhere.py"), "no such file. Give the path"),
        ("", CONFIG.replace("mine.py", "."), "cannot be imported"),
        ("", CONFIG.replace("mine.py:Mine", "often"), "no such choice. There are none, periodical"),
        ("", CONFIG.replace("mine.py", "no.such.module"), "ModuleNotFoundError"),
        ("", CONFIG.replace("mine.py:Mine", "os:system"), "system is no class"),
        ("", CONFIG.replace("mine.py:Mine", ":Mine"), "name a class as path.py:Name"),
        ("", CONFIG.replace("mine.py:Mine", "mine.py:"), "name a class as path.py:Name"),
        ("", CONFIG, "it defines no Mine"),
        ("1 / 0\n", CONFIG, "mine.py:1: pseudonyms.policy = "),
        ("\nimport sys\nsys.exit(0)\n", CONFIG, "mine.py:3: pseudonyms.policy"),
        ("raise GeneratorExit\n", CONFIG, "GeneratorExit"),
        ("\0", CONFIG, "cannot be loaded"),
        (PARAMS.format("every: int = 3") + POLICY, CONFIG + "evry = 7\n", "Did you mean pseudonyms.every?"),
        (PARAMS.format("every: int = 3") + POLICY, CONFIG + "every = 'x'\n", "pseudonyms.every = 'x' should be"),
        (PARAMS.format("every: int") + POLICY, CONFIG, "pseudonyms.every: missing. Set pseudonyms.every"),
        (PARAMS.format("every: int = None") + POLICY, CONFIG, "pseudonyms.every = None should be"),
        (PARAMS.format("every: 'Nowhere' = 3") + POLICY, CONFIG, "mine.py:3: pseudonym policy Mine: Params"),
        (PARAMS.format("every: np.ndarray = None") + POLICY, CONFIG, "Params cannot be read"),
        (PARAMS.format("every: complex = 1j") + POLICY, CONFIG, "mine.py:3: pseudonym policy Mine: Params.every is"),
        (PARAMS.format("every: float = float('nan')") + POLICY, CONFIG, "pseudonyms.every = nan: not a finite number"),
        (PARAMS.format("every: int = 10**30") + POLICY, CONFIG, "pseudonyms.every is a whole number of more than 63"),
        (PARAMS.format("every: list = []") + POLICY, CONFIG, "mine.py:3: pseudonyms.policy"),
        (PARAMS.format("every: int = 3\n    def __post_init__(self): 1 / 0") + POLICY, CONFIG, "mine.py:6: "),
        (PARAMS.format("every: int = 3\n    def __post_init__(self): exit(0)") + POLICY, CONFIG, "SystemExit"),
        (PARAMS.format("every: int = 3") + "class Mine: Params = Params()\n", CONFIG, "no method changes"),
        (PARAMS.format("every: int = 3") + POLICY.replace("self.params = params", "raise SystemExit"), CONFIG,
         "cannot be made: SystemExit: it ends the program"),
        (PARAMS.format("every: int = 3") + POLICY.replace("self.params = params", "self.x = self.y"), CONFIG,
         "mine.py:9: pseudonym policy Mine: cannot be made: AttributeError"),
        ("class Mine:\n    def __getattr__(self, name): raise SystemExit\n", CONFIG, "no method changes(ages)"),
        ("class M(type):\n    def __getattribute__(self, name): 1 / 0\nclass Mine(metaclass=M): pass\n", CONFIG,
         "the class cannot be read: ZeroDivisionError"),
        ("class Mine:\n    LARGEST_STEP_S = 'long'\n    def commands(self, state, world, beliefs, dt_s): pass\n",
         '[driver]\nmodel = "mine.py:Mine"\n', "LARGEST_STEP_S = 'long' is not a positive number"),
        ("class Mine:\n    def detection(self, listed, context): pass\n", '[[attacks]]\nattack = "mine.py:Mine"\n',
         "Did you mean detections?"),
        ("class Mine:\n    def changes(self, ages): pass\n", '[[trust_variant]]\nname = "b"\nmodel = "mine.py:Mine"\n',
         "has no method open_step"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(check, text, config, told):
    status, out, err = check(text, config)
    assert status == 2 and out == "" and err.count("\n") == 1 and err.startswith("error: ") and told in err


def test_debug_shows_the_traceback(check):
    status, _, err = check("\n1 / 0\n", CONFIG, "--debug")
    assert status == 2 and 'mine.py", line 2, in <module>' in err and err.split("\n")[-2].startswith("error: ")
