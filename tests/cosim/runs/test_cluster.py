"""Clusters: what they say when they end."""

import logging

from distributed.comm import CommClosedError

from cosim.runs.cluster import closing_quietly, local


def test_connections_that_a_cluster_closes_itself_are_not_told(caplog):
    """Dask's own loops log them with a traceback after a sweep that succeeded; other errors are told."""
    logger = logging.getLogger("asyncio")
    with closing_quietly():
        logger.error("Task exception was never retrieved", exc_info=CommClosedError("in <TCP>: Stream is closed"))
        logger.error("Future raised CommClosedError")
        logger.error("another error", exc_info=OSError("disk"))
    logger.error("CommClosedError, later")
    assert [record.getMessage() for record in caplog.records] == ["another error", "CommClosedError, later"]


def test_a_worker_of_this_machine_is_never_given_up():
    """A sweep that was stopped for five minutes lost its worker, and waited for it for ever."""
    with local(1) as client:
        assert client.cluster.scheduler.worker_ttl is None
