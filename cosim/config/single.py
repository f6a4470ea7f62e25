"""Classes chosen on the command line: exporters and metrics."""

from collections.abc import Sequence
from typing import Any

from cosim.config.data import check_keys, override, validated
from cosim.door.kinds import KINDS
from cosim.door.load import Choice, resolve


def from_command_line(
    kind: str,
    name: str,
    sets: Sequence[str] = (),
) -> tuple[Choice, tuple[Any, ...]]:
    """The class that a name on the command line refers to, and the arguments of its constructor.

    Parameters
    ----------
    sets
        Parameters of the class, each as `key=value`.

    Raises
    ------
    ValueError
        There is no such class, or its parameters are wrong. The message is one line.
    """
    choice = resolve(KINDS[kind], name)
    data: dict[str, Any] = {}
    for text in sets:
        override(data, text)
    if choice.params is None:
        if data:
            raise ValueError(f"--set {sets[0]}: {kind} {choice.of.__name__} has no parameters. Leave it out.")
        return choice, ()
    check_keys(data, choice.params, "", f"{kind} {choice.of.__name__}")
    return choice, (validated(choice.params, data, "", "--set"),)
