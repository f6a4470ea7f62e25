"""Measures how long each stage takes."""

from time import perf_counter


class Stopwatch:
    """Seconds spent per stage: `with watch("sense"): ...`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._since = "", 0.0

    def __call__(self, stage: str) -> "Stopwatch":
        self._stage, self._since = stage, perf_counter()
        return self

    def of_thread(self) -> "Stopwatch":
        """A new stopwatch for one of several threads."""
        return Stopwatch()

    def add(self, other: "Stopwatch", n_threads: int) -> None:
        """Add the seconds of one of `n_threads` parallel threads, divided by their number."""
        for stage, seconds in other.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds / n_threads

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        before = self.seconds.get(self._stage, 0.0)
        self.seconds[self._stage] = before + perf_counter() - self._since
