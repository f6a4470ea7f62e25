"""What the picture of stale trust shows, by hand."""

from cosim.addons.pictures import stale
from tests.results.tiny import fleet


def test_stale_by_place(tiny):
    lookups = [
        {
            "step": 1,
            "variant": "base",
            "subject": s,
            "receiver": r,
            "newest_evaluation_age_s": age,
            "state": "evaluated",
        }
        for s, r, age in ((5, 0, 3.0), (6, 0, 10.0), (7, 0, 10.5), (5, 1, None))
    ]
    actors = [{"step": 1, "actor": a, "x_m": 10.0 * a, "y_m": 5.0} for a in (0, 1)]
    run = tiny(3, vehicles=fleet("honest", "honest"), trust_lookups=lookups, actors=actors)
    found = stale.placed(run, 10.0).sort_values("x_m")
    assert found[["x_m", "y_m", "n", "n_stale"]].to_numpy().tolist() == [[0, 5, 3, 1], [10, 5, 1, 1]]
