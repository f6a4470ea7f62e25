"""Clusters of Dask distributed: that of a scheduler, or one on this machine."""

import logging
from asyncio import CancelledError
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import dask
from distributed import Client, LocalCluster
from distributed.comm import CommClosedError

from cosim.runs.source import code_digest

_ANSWER_S = 5
"""Longest wait for a scheduler."""
_TRIES = 10


@contextmanager
def connected(scheduler: str, needed: Path | None = None) -> Iterator[Client]:
    """A client of a scheduler whose workers run this code.

    Parameters
    ----------
    scheduler
        Its address.
    needed
        A file or folder that every worker must see; None for none.

    Raises
    ------
    ValueError
        In one line, if the scheduler or its workers cannot do the work.
    """
    try:
        client = _client(scheduler)
    except (OSError, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split())[:120]
        raise ValueError(
            f"--scheduler {scheduler}: no scheduler answers there ({reason}). Start one: dask scheduler"
        ) from None
    with client:
        _check(client, scheduler, needed)
        yield client


@contextmanager
def local(n_threads: int) -> Iterator[Client]:
    """A client of a cluster in this process, which does so many tasks at a time.

    Its worker is never given up: a process that was stopped for minutes (Ctrl-Z, a laptop that slept) goes on.
    """
    with (
        closing_quietly(),
        dask.config.set({"distributed.scheduler.worker-ttl": None}),
        LocalCluster(
            n_workers=1,
            threads_per_worker=n_threads,
            processes=False,
            memory_limit=0,
            dashboard_address="127.0.0.1:0",
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def closing_quietly() -> Iterator[None]:
    """Suppress log messages about connections that are closed: by a cluster that ends, or by a scheduler that is lost.

    They are not errors, or whoever uses the cluster says it in one line.
    """

    def is_news(record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        is_closed = any(words in record.getMessage() for words in ("CommClosedError", "Failed to reconnect"))
        return not (is_closed or isinstance(error, CommClosedError | CancelledError))

    loggers = [logging.getLogger(name) for name in ("distributed", "tornado.application", "asyncio")]
    filtered = [*loggers, *(handler for logger in loggers for handler in logger.handlers)]
    for one in filtered:
        one.addFilter(is_news)
    try:
        yield
    finally:
        for one in filtered:
            one.removeFilter(is_news)


def _client(scheduler: str) -> Client:
    for _ in range(_TRIES):
        with suppress(AssertionError):  # Dask's client does not expect that a worker registers at the same moment
            return Client(scheduler, timeout=_ANSWER_S)
    raise TimeoutError("workers were registering all the time")


def _check(client: Client, scheduler: str, needed: Path | None) -> None:
    """Raise ValueError if there are no workers, if they run another version of cosim, or do not see what is needed."""
    if not client.scheduler_info()["workers"]:
        raise ValueError(
            f"--scheduler {scheduler}: it has no workers. Start some: dask worker {scheduler} --nthreads 1"
        )
    try:
        seen = client.run(_look, None if needed is None else str(needed))
    except Exception as error:  # a worker without this code can answer with any error
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise ValueError(
            f"--scheduler {scheduler}: its workers cannot run cosim ({reason}). Install it there."
        ) from None
    mine = code_digest()
    for worker, (digest, is_there) in seen.items():
        if digest != mine:
            raise ValueError(
                f"--scheduler {scheduler}: worker {worker} runs another version of cosim ({digest}, here {mine}). "
                "Install the same one, and start the workers again."
            )
        if not is_there:
            raise ValueError(f"--scheduler {scheduler}: worker {worker} does not see {needed}. Use a shared folder.")


def _look(needed: str | None) -> tuple[str, bool]:
    return code_digest(), needed is None or Path(needed).exists()
