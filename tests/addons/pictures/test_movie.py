"""The movie of a run."""

import numpy as np

from cosim.addons.pictures.movie_figure import _Film
from tests.results.tiny import fleet, make


def test_rings_are_around_malicious_vehicles_from_their_first_attack_on(tmp_path):
    """Vehicle 1 attacks from step 2 on, vehicle 2 never does, and unreliable vehicle 3 does not attack."""
    vehicles = fleet("honest", "malicious", "malicious", "unreliable")
    vehicles[1]["attack_start_step"] = vehicles[3]["attack_start_step"] = 2
    actors = [{"step": step, "actor": a, "x_m": 10.0 * a, "y_m": 5.0} for step in (1, 2) for a in range(4)]
    run = make(tmp_path, 3, vehicles=vehicles, actors=actors, detections=[], trust=[])
    film = _Film(run, None, np.array([1, 2]), [], [])
    for step, rings in ((1, []), (2, [[10.0, 5.0]])):
        film.show(step)
        assert film._liars.get_offsets().tolist() == rings
