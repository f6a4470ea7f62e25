"""The choice of radio medium."""

from collections.abc import Callable
from typing import Any, Protocol

from cosim.radio.csma import CsmaMedium
from cosim.radio.message_round import MessageRound, Messages, RoundKind, Stations
from cosim.radio.params import RadioParams
from cosim.radio.unit_disk import UnitDiskMedium
from sensors.line_of_sight import LosOfPlaces


class Medium(Protocol):
    """A broadcast medium between stations.

    Built once from params, duration of a round [s], seed, and the city's lines of sight (None without buildings).
    All that lasts from round to round is in the state, which can be copied and pickled; a medium changes nothing else.
    """

    def start(self) -> Any:
        """The state before the first round."""

    def broadcast(
        self, state: Any, kind: RoundKind, step: int, begin_s: float, stations: Stations, messages: Messages
    ) -> tuple[Any, MessageRound]:
        """One round of messages that begins at `begin_s`; consumes the state."""


MEDIA: dict[str, Callable[[RadioParams, float, int, LosOfPlaces | None], Medium]] = {
    "csma": CsmaMedium,
    "unit_disk": UnitDiskMedium,
}
"""Media by the value of `radio.model`."""
