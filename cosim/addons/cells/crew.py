"""The workers of a run: starts them, asks them, and replaces those that die."""

import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from time import perf_counter
from types import TracebackType
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.cells.channel import Channel
from cosim.addons.cells.nursery import Forked
from cosim.addons.cells.worker import Reply
from cosim.runs.stop import Failed
from cosim.step.mixed_perception import MixedPerception
from cosim.step.perception import Perception

_MOST_DEATHS = 8
"""A worker that dies so many times over one request will not live through it."""


class CellLost(OSError):
    """The worker of a cell died again and again. The message is one line."""


@dataclass(frozen=True, slots=True)
class CellCost:
    """What the work of the cells took, summed over their answers."""

    cpu_s: Float[ndarray, "cells"]
    """Processor time of each cell."""
    sense_s: float
    """Of this, requests to sense."""
    wait_s: float
    """Time from the last question of a request to its last answer."""
    n_bytes: int
    """Bytes sent and received."""

    @staticmethod
    def none(n_cells: int) -> "CellCost":
        """Before the first request."""
        return CellCost(np.zeros(n_cells), 0.0, 0.0, 0)

    def after(self, senses: bool, spent_s: Float[ndarray, "cells"], wait_s: float, n_bytes: int) -> "CellCost":
        """The same with one more request."""
        return CellCost(
            cpu_s=self.cpu_s + spent_s,
            sense_s=self.sense_s + float(spent_s.sum()) * senses,
            wait_s=self.wait_s + wait_s,
            n_bytes=n_bytes,
        )


class Workers(Protocol):
    """Where the workers of cells come from."""

    room: int
    """So many can compute at once, beside the process of the run."""

    def new(self, own: Sequence[str], perception: Any) -> Channel:
        """A channel to a worker that has this perception, or is about to get it.

        `own` names the user's own classes in it.

        Raises
        ------
        EOFError, OSError
            If it has not begun. Another try may succeed.
        CellLost
            If no other try can.
        """

    def close(self) -> None:
        """Start no more workers. Those that have begun end with their channels."""


class Crew:
    """One worker process per cell; a context manager, with which the workers end.

    If a worker dies, another one repeats the requests that made what the worker kept for this step (and for the next
    one, if its sweeps have begun), then the request that it died over. The results are the same.

    Parameters
    ----------
    n_cells
        Number of workers.
    perception
        The perception of the run.
    own
        Names of the user's own classes in it, as a config has them.
    source
        Where the workers come from; None for this machine. It is closed with the crew.
    """

    def __init__(
        self, n_cells: int, perception: Perception | MixedPerception, own: Sequence[str] = (),
        source: Workers | None = None,
    ) -> None:  # fmt: skip
        self.n_cells = n_cells
        self.n_replaced = 0
        """Workers that died and were replaced."""
        self.n_bytes = 0
        """Bytes sent to and received from workers that are no longer there."""
        self.cost = CellCost.none(n_cells)
        """What the answers so far took."""
        self.peak_bytes = 0
        """Largest memory of a worker, with the program and the city, which the workers share."""
        self.stages_s: dict[str, float] = {}
        """Seconds per stage, summed over the cells."""
        self.pids: list[int] = []
        """Process of each worker."""
        self._perception, self._own = perception, list(own)
        self._source = Forked() if source is None else source
        self._workers: list[Channel] = []
        self._made_with: list[list[tuple[str, Any]]] = [[] for _ in range(n_cells)]
        """The requests after which each worker keeps something."""
        self._lock = threading.Lock()

    def __enter__(self) -> "Crew":
        try:
            for _ in range(self.n_cells):
                worker, pid = self._new_worker()
                self._workers.append(worker)
                self.pids.append(pid)
        except CellLost as error:
            self.close()
            raise Failed(f"{error}. Nothing was written.") from None
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def ask(self, service: str, given: Sequence[tuple[Any, ...] | None], keeps: bool = False) -> list[Any]:
        """Ask all cells at once.

        Parameters
        ----------
        service
            Method of `cosim.addons.cells.worker.Worker`.
        given
            Arguments per cell; None if a cell has nothing to do.
        keeps
            Whether later requests of the step need what the workers keep of this one.

        Returns
        -------
        Results per cell, None where nothing was asked. The next request overwrites their arrays.

        Raises
        ------
        CellLost
            If a worker dies again and again.
        """
        with self._lock:
            for cell, arguments in enumerate(given):
                if arguments is not None:
                    with suppress(ConnectionError):  # a worker that has died is noticed when its answer is read
                        self._workers[cell].send((service, arguments))
            asked = [cell for cell, arguments in enumerate(given) if arguments is not None]
            results: list[Any] = [None] * self.n_cells
            spent_s, asked_at_s = np.zeros(self.n_cells), perf_counter()
            for cell in asked:
                reply = self._reply(cell, (service, given[cell]))
                spent_s[cell] = reply.cpu_s
                self.peak_bytes = max(self.peak_bytes, reply.peak_bytes)
                for stage, seconds in reply.stages_s.items():
                    self.stages_s[stage] = self.stages_s.get(stage, 0.0) + seconds
                if keeps:
                    before = self._made_with[cell]
                    if service == "perceived":  # of the rest, only the sweeps are of this step
                        before = [made for made in before if made[0] == "perceive"][-1:]
                    self._made_with[cell] = [*before, (service, given[cell])]
                results[cell] = reply.result
            senses = service in ("perceive", "perceived")
            self.cost = self.cost.after(senses, spent_s, perf_counter() - asked_at_s, self._n_bytes())
            if failed := next((result for result in results if isinstance(result, Exception)), None):
                raise failed
            return results

    def _reply(self, cell: int, request: tuple[str, Any]) -> Reply:
        """The reply to a request that was sent; from another worker if the one that was asked has died."""
        for _ in range(_MOST_DEATHS):
            try:
                found: Reply = self._workers[cell].receive()
                return found
            except (EOFError, OSError):
                self._replace(cell)
            with suppress(EOFError, ConnectionError):
                for before in self._made_with[cell]:
                    self._workers[cell].send(before)
                    self._workers[cell].receive()
                self._workers[cell].send(request)
        raise CellLost(f"the worker of cell {cell} died {_MOST_DEATHS} times over one request (out of memory?)")

    def _replace(self, cell: int) -> None:
        """Another worker in the place of one that has died."""
        self.n_replaced += 1
        self.n_bytes += self._workers[cell].n_bytes
        self._workers[cell].close()
        self._workers[cell], self.pids[cell] = self._new_worker()

    def _new_worker(self) -> tuple[Channel, int]:
        """A worker that has begun, and its process."""
        for _ in range(_MOST_DEATHS):
            try:
                channel = self._source.new(self._own, self._perception)
            except CellLost:
                raise
            except (EOFError, OSError):
                continue
            try:
                channel.send(("pid", ()))
                return channel, int(channel.receive().result)
            except (EOFError, OSError):
                channel.close()
        raise CellLost("the workers of the cells cannot be started (out of memory or processes?)")

    def close(self) -> None:
        """End the workers."""
        for worker in self._workers:
            self.n_bytes += worker.n_bytes
            worker.close()
        self._workers = []
        self._source.close()

    def _n_bytes(self) -> int:
        return self.n_bytes + sum(worker.n_bytes for worker in self._workers)
