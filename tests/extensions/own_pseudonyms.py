"""A pseudonym policy of one's own: a change every so many messages."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [pseudonyms] that belong to this policy."""

    every_messages: int = 6
    """Messages under one pseudonym."""


class Every:
    """A change after a fixed number of messages."""

    Params = Params

    def __init__(self, params):
        self.params = params

    def changes(self, ages):
        return ages.n_messages >= self.params.every_messages
