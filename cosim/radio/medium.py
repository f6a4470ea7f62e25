"""The choice of radio medium."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.addons import Choices
from cosim.radio.csma import CsmaMedium
from cosim.radio.link_cache import LinkCache
from cosim.radio.message_round import MessageRound, Messages, RoundKind, Stations
from cosim.radio.params import RadioParams
from cosim.radio.unit_disk import UnitDiskMedium
from sensors.line_of_sight import LosOfPlaces


class Medium(Protocol):
    """A broadcast medium between stations.

    A medium is built once, from its parameters, the duration of a round [s], the seed, and the city's lines of sight
    (None without buildings). Everything that lasts from round to round is in the state, which can be copied and
    pickled. A medium changes nothing else.
    """

    def start(self) -> Any:
        """The state before the first round."""

    def broadcast(
        self, state: Any, kind: RoundKind, step: int, begin_s: float, stations: Stations, messages: Messages
    ) -> tuple[Any, MessageRound]:
        """Carry out one round of messages. The caller does not use the old state again.

        Parameters
        ----------
        state
            The state before the round.
        kind, step
            Which of the two rounds of the step it is, and the number of the step.
        begin_s
            Time since recording began at which the round begins.
        stations
            Present stations. Their rows may differ from round to round, but a station keeps its key.
        messages
            Messages of the round. Those of length 0 are not sent. A medium that forwards leaves out `refused`.

        Returns
        -------
        The state after the round, and its receptions and frame outcomes.
        """


@runtime_checkable
class LinksAhead(Protocol):
    """A medium whose links of a round can be computed before the round."""

    def links(self, stations: Stations, senders: Int[ndarray, "k"] | None = None) -> LinkCache:
        """Links of these stations, or of the senders among them. The medium's state keeps them as `cache`."""


def gap_s(medium: Medium, state: Any, stations: Stations) -> Float[ndarray, "n"]:
    """Least time between two frames of each station that congestion control allows now; 0 without it [s]."""
    return medium.gap_s(state, stations) if isinstance(medium, CsmaMedium) else np.zeros(len(stations))


_MakeMedium = Callable[[RadioParams, float, int, LosOfPlaces | None], Medium]
MEDIA: Mapping[str, _MakeMedium] = Choices("medium", {"csma": CsmaMedium, "unit_disk": UnitDiskMedium})
"""Media by the value of `radio.model`."""
