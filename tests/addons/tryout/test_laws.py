"""Classes that break one law each are caught by that law; what ships keeps them all."""

import pytest

from cosim.addons.tryout.findings import smallest
from cosim.addons.tryout.tryout import try_class
from cosim.door.kinds import KINDS

BROKEN = {
    "LastWins": ("the order of messages", "2 messages ("),
    "Shared": ("what one holder receives", "Without the messages that others receive"),
    "Forgetful": ("asking for scores", "Asked for scores twice"),
    "KnowsNumbers": ("numbers and order of the actors", "Step 2, 3 actors: trust of"),
    "Impatient": ("the order of messages", "raised ValueError: too late"),
    "Ahead": ("in the step that they are about", "returned newest_step[0] = 15"),
    "Peeks": ("does not read the truth", "with other vehicles as attackers"),
    "Unkept": ("goes on from a checkpoint", "numbers is a itertools.count"),
    "DeniesTheTrue": ("does not read the truth", "evaluations() reads the truth"),
    "SparesAttackers": ("does not read the truth", "`world.attack` of its own members"),
    "RowDelays": ("numbers and order of the actors", "generation_offset_s of detections message 0 from"),
    "RandomAttack": ("asked twice", "Draw with context.uniforms"),
    "OldestChanges": ("each vehicle changes for itself", "among 10 vehicles, and does when it is alone"),
    "RowChanges": ("each vehicle changes for itself", "when it is alone"),
    "OwnGenerator": ("asked twice", "broadcast() is asked the same twice"),
    "GeneratorInState": ("numbers and order of the actors", "detections message 0 from"),
    "NoSeed": ("the same seed", "played a second time with the same seed"),
    "NoisyRows": ("numbers and order of the actors", "with other actor numbers"),
    "HiddenState": ("goes on from a checkpoint", "speed_mps of the command to"),
    "KeepsAFunction": ("goes on from a checkpoint", "state[1].driver is a"),
    "KnowsAttackers": ("does not read the truth", "the command to"),
    "RandomFile": ("asked twice", "Its files differ"),
    "LastOnDisk": ("blocks", "follow the order of rows on disk"),
    "Fails": ("it runs", "rows() raised ZeroDivisionError"),
}
"""By class of `tests.addons.tryout.bad`: the law, and what is told about it."""
OFTEN = ("LastWins", "Impatient", "DeniesTheTrue")
"""Those that are tried in every run of the tests. `test_commands.py` tries a policy."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in OFTEN else pytest.mark.verify) for name in BROKEN]
)
def test_a_broken_law_is_told(name):
    law, words = BROKEN[name]
    broken = {one.law: one.broken for one in try_class(f"tests.addons.tryout.bad:{name}").findings if one.broken}
    (told,) = [text for found, text in broken.items() if law in found]
    assert words in told and "\n" not in told


@pytest.mark.verify
@pytest.mark.parametrize("name", ["Counting", "OfTheServer", "KeyedMedium"])
def test_a_class_without_mistakes_keeps_all_laws(name):
    assert not [one for one in try_class(f"tests.addons.tryout.bad:{name}").findings if one.broken]


@pytest.mark.parametrize(("name", "is_noted"), [("Silent", True), ("Counting", False)])
def test_a_class_that_does_nothing_gets_a_note(name, is_noted):
    assert try_class(f"tests.addons.tryout.bad:{name}").note.startswith("It did nothing") == is_noted


QUICK = ("trust", "beta")


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        pytest.param(kind.name, name, marks=() if (kind.name, name) == QUICK else pytest.mark.verify)
        for kind in KINDS.values() for name in kind.shipped if kind.name != "exporter" or name == "veremi-nextgen"
    ],
)  # fmt: skip
def test_what_ships_keeps_all_laws(kind, name):
    assert not [one for one in try_class(name, kind).findings if one.broken]


def test_smallest():
    found = smallest(list(range(100)), lambda some: {13, 77} <= set(some))
    assert {13, 77} <= set(found) and len(found) < 10
