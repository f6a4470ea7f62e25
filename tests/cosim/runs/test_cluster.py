"""Clusters: what they say when they end."""

import logging

from distributed.comm import CommClosedError

from cosim.runs.cluster import closing_quietly


def test_connections_that_a_cluster_closes_itself_are_not_told(caplog):
    """Dask's own loops log them with a traceback after a sweep that succeeded; other errors are told."""
    logger = logging.getLogger("asyncio")
    with closing_quietly():
        logger.error("Task exception was never retrieved", exc_info=CommClosedError("in <TCP>: Stream is closed"))
        logger.error("Future raised CommClosedError")
        logger.error("another error", exc_info=OSError("disk"))
    logger.error("CommClosedError, later")
    assert [record.getMessage() for record in caplog.records] == ["another error", "CommClosedError, later"]
