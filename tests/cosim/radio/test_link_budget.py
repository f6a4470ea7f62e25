import numpy as np
import pytest

from cosim.radio.link_budget import links_between, pairs, pairs_within
from cosim.radio.propagation import PropagationParams, tr37885_db
from sensors.line_of_sight import LosOfPlaces, WallIndex
from sensors.scene import Scene

ONE = np.uint64(1)
PLAIN = {"shadowing": False, "blockage": "none", "fading": "none"}


def los_of(*rings):
    """Buildings of 9 m."""
    city = Scene.from_footprints([[np.array(r)] for r in rings], [0.0] * len(rings), [9.0] * len(rings))
    return LosOfPlaces(WallIndex.of(city.buildings))


def four_houses():
    square = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]])
    return los_of(*(square + np.array([x, y]) for x in (100, 300) for y in (50, 350)))


def scatter(n, side_m, seed=0):
    g = np.random.default_rng(seed)
    return np.column_stack([g.uniform(0, side_m, (n, 2)), np.full(n, 1.5)])


def as_set(a, b):
    return {(min(i, j), max(i, j)) for i, j in zip(a.tolist(), b.tolist(), strict=True)}


@pytest.mark.parametrize("side_m", [50.0, 1000.0, 30_000.0])
def test_all_pairs_in_range_each_once(side_m):
    xyz = scatter(300, side_m)
    a, b, d = pairs_within(xyz, 200.0)
    full = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    assert as_set(a, b) == as_set(*np.nonzero(np.triu(full <= 200.0, 1)))
    assert len(as_set(a, b)) == len(a)
    assert d == pytest.approx(full[a, b])


def test_links_by_hand():
    # A wall between the first and the second; the third sees both.
    xyz = np.array([[0.0, 0.0, 1.5], [40.0, 0.0, 1.5], [20.0, 40.0, 1.5]])
    los = los_of([[18.0, -20.0], [22.0, -20.0], [22.0, 5.0], [18.0, 5.0]])
    key = np.array([9, 1, 5], np.uint64)
    links = links_between(xyz, key, PropagationParams(**PLAIN), ONE, los)
    assert links.ptr.tolist() == [0, 2, 4, 6]
    for sender, receiver, hidden in ((0, 1, True), (1, 0, True), (0, 2, False), (2, 1, False)):
        at = np.flatnonzero(links.receiver[links.ptr[sender] : links.ptr[sender + 1]] == receiver) + links.ptr[sender]
        d = np.array([np.linalg.norm(xyz[sender] - xyz[receiver])])
        expected = 23 - tr37885_db(d, np.array([hidden]), "urban")
        assert 10 * np.log10(links.power_mw[at]) == pytest.approx(expected, abs=1e-4)
    found = pairs(xyz, PropagationParams(**PLAIN), ONE, los)
    nlos = {frozenset(pair): hidden for *pair, hidden in zip(found.a, found.b, found.nlos, strict=True)}
    assert nlos == {frozenset((0, 1)): True, frozenset((0, 2)): False, frozenset((1, 2)): False}


def test_loss_per_wall_and_metre():
    xyz = np.array([[0.0, 0.0, 1.5], [40.0, 0.0, 1.5]])
    los = los_of([[18.0, -20.0], [22.0, -20.0], [22.0, 5.0], [18.0, 5.0]])
    # Two walls and 4 m: 2 x 9 + 4 x 0.4 = 19.6 dB more than free space.
    params = PropagationParams(model="free_space", walls="sommer", **PLAIN)
    assert pairs(xyz, params, ONE, los).loss_db - pairs(xyz, params, ONE).loss_db == pytest.approx(19.6)


@pytest.mark.parametrize(("tx_power_dbm", "n"), [(0.0, 0), (10.0, 1)])
def test_power_decides_what_counts(tx_power_dbm, n):
    xyz = np.array([[0.0, 0.0, 1.5], [300.0, 0.0, 1.5]])
    params = PropagationParams(model="log_distance", tx_power_dbm=tx_power_dbm, **PLAIN)  # 115.98 dB
    links = links_between(xyz, np.array([1, 2], np.uint64), params, ONE)
    assert links.ptr.tolist() == [0, n, 2 * n]


def test_a_link_is_a_function_of_the_positions():
    xyz, params = scatter(60, 400.0), PropagationParams()
    key = np.arange(60, dtype=np.uint64)
    links = links_between(xyz, key, params, ONE)
    full = {(i, j): p for i in range(60) for j, p in zip(
        links.receiver[links.ptr[i] : links.ptr[i + 1]].tolist(), links.power_mw[links.ptr[i] : links.ptr[i + 1]],
        strict=True)}  # fmt: skip
    assert all(full[j, i] == p for (i, j), p in full.items())  # both ways the same
    some = np.random.default_rng(1).permutation(60)[:40]
    fewer = links_between(xyz[some], key[some], params, ONE)
    for i in range(40):
        for e in range(fewer.ptr[i], fewer.ptr[i + 1]):
            assert full[some[i], some[fewer.receiver[e]]] == fewer.power_mw[e]
    again = links_between(xyz, key, params, np.uint64(2))
    assert not np.array_equal(again.power_mw, links.power_mw)


def test_a_wall_never_brings_more_power():
    xyz, params = scatter(200, 600.0), PropagationParams(**PLAIN, interference_range_nlos_m=1000.0)
    los = four_houses()
    free, built = pairs(xyz, params, ONE), pairs(xyz, params, ONE, los)
    loss = dict(zip(zip(free.a.tolist(), free.b.tolist(), strict=True), free.loss_db, strict=True))
    assert built.nlos.any()
    assert all(
        x >= loss[i, j] for i, j, x in zip(built.a.tolist(), built.b.tolist(), built.loss_db, strict=True)
    )  # fmt: skip


def test_without_los_the_interference_range_is_shorter():
    xyz, params = (
        scatter(200, 600.0),
        PropagationParams(**PLAIN, interference_range_m=500.0, interference_range_nlos_m=100.0),
    )
    los = four_houses()
    found = pairs(xyz, params, ONE, los)
    a, b, d = pairs_within(xyz, 500.0)
    clear = los.has_los(xyz, a, b)
    keep = clear | (d <= 100)
    assert as_set(found.a, found.b) == as_set(a[keep], b[keep])
    assert not np.any(found.nlos & (found.distance_m > 100))
    assert as_set(found.a[found.nlos], found.b[found.nlos]) == as_set(a[~clear & (d <= 100)], b[~clear & (d <= 100)])


def test_at_most_one_station():
    for n in (0, 1):
        links = links_between(np.zeros((n, 3)), np.arange(n, dtype=np.uint64), PropagationParams(), ONE)
        assert links.ptr.tolist() == [0] * (n + 1)
        assert len(pairs(np.zeros((n, 3)), PropagationParams(), ONE).a) == 0


def test_faults_are_named():
    with pytest.raises(ValueError, match="finite"):
        links_between(np.array([[0.0, np.nan, 1.5]]), np.array([1], np.uint64), PropagationParams(), ONE)


def test_a_street_on_a_hill_is_blocked_like_one_in_the_valley():
    """Antennas 1.5 m above streets at 0 and at 80 m: blockage and reflections depend on the height above the street."""
    low = scatter(80, 300.0)
    high, above_m = low + [0.0, 0.0, 80.0], np.full(80, 1.5)
    for params in (PropagationParams(), PropagationParams(model="two_ray_interference")):
        one, other = pairs(low, params, ONE), pairs(high, params, ONE, above_street_m=above_m)
        np.testing.assert_array_equal(one.loss_db, other.loss_db)
    assert one.loss_db.any()
