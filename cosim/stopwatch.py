"""How long each stage takes."""

from time import perf_counter


class Stopwatch:
    """Seconds spent per stage: `with watch("sense"): ...`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._since = "", 0.0

    def __call__(self, stage: str) -> "Stopwatch":
        self._stage, self._since = stage, perf_counter()
        return self

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + perf_counter() - self._since
