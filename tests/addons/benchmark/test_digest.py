"""The hash of the code behind a table of the benchmark."""

import pytest

from cosim.addons.benchmark.digest import code_digest

CODE = '''"""A module."""
class Model:
    """A model."""

    decay: float = 0.9
    """Per second."""

    def trust(self, pos, neg):
        """Laplace's rule."""
        return (pos + 1) / (pos + neg + 2)  # prior 1/2
'''


def of(folder, text, name="model.py"):
    (folder / name).write_text(text)
    return code_digest([folder / name])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("  # prior 1/2", ""), ('"""Laplace\'s rule."""', '"""The mean of a Beta distribution."""'),
        ("Per second", "Share per second"), ('"""A module."""\n', ""), ("pos + neg + 2)", "pos\n+ neg + (2))"),
    ],
)  # fmt: skip
def test_words_and_layout_leave_it(tmp_path, old, new):
    assert old in CODE
    assert of(tmp_path, CODE.replace(old, new)) == of(tmp_path, CODE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("0.9", "0.90001"), ("neg + 2", "neg + 2.0"), ("pos + 1", "pos - 1"), ("decay", "decays"),
        ("(self, pos, neg)", "(self, neg, pos)"), ("return (pos", "return -(pos"), ("class Model", "class Other"),
    ],
)  # fmt: skip
def test_code_changes_it(tmp_path, old, new):
    assert old in CODE
    assert of(tmp_path, CODE.replace(old, new)) != of(tmp_path, CODE)


def test_names_of_files_and_python_versions(tmp_path):
    assert of(tmp_path, CODE) != of(tmp_path, CODE, "other.py")
    assert of(tmp_path, CODE) == "0fc9b148dc86", "the same in all versions of Python"
