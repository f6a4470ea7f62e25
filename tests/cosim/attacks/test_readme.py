"""The table of attacks is that of the catalogue, and each attack says what it is."""

import re
from pathlib import Path

from cosim.attacks import catalogue

README = Path(catalogue.__file__).parent / "README.md"


def test_the_table_names_every_attack_once():
    rows = re.findall(r"^\| `(\w+)` \| (.+) \| (.+) \|$", README.read_text(), re.M)
    assert sorted(name for name, _, _ in rows) == sorted(catalogue.ATTACKS)
    assert all(what and source for _, what, source in rows)


def test_every_attack_and_parameter_is_documented():
    for attack in catalogue.ATTACKS.values():
        assert attack.__doc__ and "\n\n\n" not in attack.__doc__
        assert any(hasattr(attack, hook) for hook in ("phantoms", "detections", "evaluations", "identities", "sending"))
