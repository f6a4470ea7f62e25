"""A driver of one's own that reacts to nothing and writes down what its vehicles believe."""

from dataclasses import dataclass
from pathlib import Path

from cosim.extend import SpeedCommands


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [driver] that belong to this driver."""

    log: str = "beliefs.txt"
    """File that gets a line per step."""


class Logger:
    """Counts the believed objects that the vehicle itself did not detect."""

    Params = Params

    def __init__(self, params):
        self.params = params

    def commands(self, state, world, beliefs, dt_s):
        if beliefs is None:  # between two sweeps
            return state, SpeedCommands.none()
        unseen = ~beliefs.ego_detected & (beliefs.score > 0.5)
        with Path(self.params.log).open("a", encoding="utf-8") as file:
            file.write(f"{world.step} {int(unseen.sum())}\n")
        return state, SpeedCommands.none()
