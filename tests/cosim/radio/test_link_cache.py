"""Links of some senders: the same, in every bit and in the same order, as among the links of all."""

import numpy as np
import pytest

from cosim.base import rng
from cosim.radio.link_cache import LinkCache
from cosim.radio.message_round import Stations
from cosim.radio.params import RadioParams
from sensors.line_of_sight import LosOfPlaces, WallIndex
from tests.bench.radio import city_blocks

LOS = LosOfPlaces(WallIndex.of(city_blocks(1500.0)))
N = 300


def stations():
    xy_m = np.random.default_rng(3).uniform(0, 1500, (N, 2))
    return Stations(rng.keys(np.uint64(1), np.arange(N)), np.column_stack([xy_m, np.full(N, 1.6)]), N)


def rows_of(cache, station):
    """Links and neighbours of one station."""
    links, near = cache.links, cache.neighbours
    of, beside = (slice(ptr[station], ptr[station + 1]) for ptr in (links.ptr, near.ptr))
    return [c[of] for c in (links.receiver, links.power_mw, links.fading)] + [c[beside] for c in near[1:]]


def assert_complete(cache, every, senders):
    assert np.flatnonzero(cache.sends).tolist() == list(senders)
    for station in senders:
        for mine, theirs in zip(rows_of(cache, station), rows_of(every, station), strict=True):
            np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("los", [None, LOS])
def test_links_of_some_are_those_among_all(los):
    every = LinkCache.of(stations(), RadioParams(), 1, los)
    assert every.sends.all()
    sends = np.arange(N) % 5 == 0
    some = LinkCache.of(stations(), RadioParams(), 1, los, sends)
    assert_complete(some, every, range(0, N, 5))
    assert (np.diff(some.links.ptr)[~sends] == 0).all()
    more = some.and_also(LinkCache.of(stations(), RadioParams(), 1, los, np.arange(N) % 7 == 3))
    assert_complete(more, every, [k for k in range(N) if k % 5 == 0 or k % 7 == 3])


def test_nobody_sends():
    cache = LinkCache.of(stations(), RadioParams(), 1, LOS, np.zeros(N, bool))
    assert len(cache.links.receiver) == 0 and len(cache.neighbours.station) == 0
