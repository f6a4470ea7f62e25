"""The kinds of choices: their keys in the config, the included classes, and the methods (hooks) of a class of the kind.

The module `load` loads a user's own class, and the adapter in `guard` checks the calls of its instances.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from cosim.attacks.catalogue import ATTACKS
from cosim.base.addons import Choices
from cosim.door import returns
from cosim.messages.pseudonyms import POLICIES
from cosim.radio.medium import MEDIA
from cosim.traffic.driver import DRIVERS
from sensors.detector import DETECTORS
from trust.models import MODELS

Check = Callable[..., Any]
"""Takes a `returns.Call` and a result. Returns the result with copies of its arrays, or raises `returns.Wrong`."""


@dataclass(frozen=True, slots=True)
class Hook:
    """A method of a class of one kind."""

    parameters: tuple[str, ...]
    """Names of its positional parameters without `self`. It is called by position."""
    check: Check
    """Checks its result."""
    is_required: bool = True


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of choice."""

    name: str
    """Name on the command line, such as "trust"."""
    title: str
    """Name in messages, such as "trust model"."""
    section: str
    """Section of the config that chooses one. Empty for a kind that is chosen on the command line."""
    key: str
    """Key of that section."""
    shipped: Mapping[str, Any]
    """The included classes, by their name in the config."""
    hooks: Mapping[str, Hook]
    """Methods of a class by name. A class must have every required one, and at least one."""
    arguments: tuple[str, ...] = ("params",)
    """Arguments of the constructor. `params` is an instance of the class's `Params`."""
    section_params: bool = False
    """Whether a class without `Params` gets the parameters of the section. Otherwise it gets none."""
    numbers: Mapping[str, str] = field(default_factory=dict)
    """Optional class attributes that must be positive numbers, and the meaning of each."""

    @property
    def place(self) -> str:
        """Section and key, such as `trust.model`."""
        return f"{self.section}.{self.key}" if self.section else self.name

    @property
    def a_title(self) -> str:
        """The title with its article."""
        return returns.with_article(self.title)

    @property
    def required(self) -> list[str]:
        """Hooks that every class of the kind has."""
        return [name for name, hook in self.hooks.items() if hook.is_required]


def _of_each(high: float, parameters: tuple[str, ...] = ("n_points", "label", "range_m")) -> Hook:
    """A method that a detector may have: a number from 0 to `high` for each object."""
    return Hook(parameters, returns.one_each(high), is_required=False)


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(
            "detector",
            "detector",
            "detector",
            "model",
            DETECTORS,
            {
                "detect": Hook(("sweeps", "seen", "boxes", "label", "draws"), returns.reports),
                "recall": _of_each(1.0),
                "position_sigma_m": _of_each(returns.FARTHEST_M),
                "heading_sigma_rad": _of_each(math.pi),
                "error_by_score": _of_each(1e6, ("score", "n_points", "label")),
                "size_sigma": _of_each(10.0),
            },
        ),
        Kind(
            "medium",
            "radio medium",
            "radio",
            "model",
            MEDIA,
            {
                "start": Hook((), returns.anything),
                "broadcast": Hook(("state", "kind", "step", "begin_s", "stations", "messages"), returns.message_round),
            },
            arguments=("params", "round_s", "seed", "los"),
            section_params=True,
        ),
        Kind(
            "policy",
            "pseudonym policy",
            "pseudonyms",
            "policy",
            POLICIES,
            {"changes": Hook(("ages",), returns.pseudonym_changes)},
        ),
        Kind(
            "trust",
            "trust model",
            "trust",
            "model",
            MODELS,
            {
                "open_step": Hook(("step", "pseudonyms", "observer_row", "detection_index", "score"), returns.nothing),
                "add_evaluations": Hook(("received",), returns.nothing),
                "scores": Hook(("now_step",), returns.trust_scores),
                "score_objects": Hook(("reports",), returns.object_scores, is_required=False),
            },
            arguments=("params", "dt_s"),
            section_params=True,
        ),
        Kind(
            "driver",
            "driver",
            "driver",
            "model",
            DRIVERS,
            {"commands": Hook(("state", "world", "beliefs", "dt_s"), returns.speed_commands)},
            numbers={"LARGEST_STEP_S": "the longest step of traffic that the driver can command, in seconds"},
        ),
        Kind(
            "attack",
            "attack",
            "attacks",
            "attack",
            ATTACKS,
            {
                "detections": Hook(("listed", "context"), returns.attacked_detections, is_required=False),
                "evaluations": Hook(("rows", "detections", "context"), returns.attacked_evaluations, is_required=False),
                "identities": Hook(("context",), returns.identities, is_required=False),
                "sending": Hook(("context",), returns.sending, is_required=False),
                "phantoms": Hook(("seen", "context"), returns.phantoms, is_required=False),
            },
        ),
        Kind(
            "exporter",
            "exporter",
            "",
            "",
            Choices("exporter", {}),
            {"plan": Hook(("selection",), returns.plan)},
        ),
        Kind("metric", "metric", "", "", {}, {"rows": Hook(("run",), returns.metric_rows)}),
    )
}
"""Every kind of choice, by name."""

SECTIONS = {kind.section: kind for kind in KINDS.values() if kind.section}
"""The kinds that a config chooses, by section."""
