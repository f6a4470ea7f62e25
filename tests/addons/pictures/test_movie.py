"""The movie of a run."""

import numpy as np
import pytest

from cosim.addons.pictures import movie_figure
from cosim.addons.pictures.movie_figure import _Film
from tests.drive import full_disk
from tests.results.tiny import fleet, make


def test_rings_and_trust(tmp_path):
    """Vehicle 1 attacks from step 2 on, vehicle 2 never does, and unreliable vehicle 3 does not attack.

    Vehicle 0 has another pseudonym in each step, and the server rates all of them.
    """
    vehicles = fleet("honest", "malicious", "malicious", "unreliable")
    vehicles[1]["attack_start_step"] = vehicles[3]["attack_start_step"] = 2
    actors = [{"step": step, "actor": a, "x_m": 10.0 * a, "y_m": 5.0} for step in (1, 2) for a in range(4)]
    used = [{"pseudonym": p, "vehicle": p % 4, "from_step": p // 4, "to_step": 2} for p in (0, 1, 2, 3, 4, 8)]
    rated = [{"step": 1, "subject": p, "trust": p / 16, "n_evaluations": 1} for p in (8, 4, 0, 1)]
    run = make(tmp_path, 3, vehicles=vehicles, pseudonyms=used, actors=actors, detections=[], trust=rated)
    film = _Film(run, None, np.array([1, 2]), [], [])
    for step, rings in ((1, []), (2, [[10.0, 5.0]])):
        film.show(step)
        assert film._liars.get_offsets().tolist() == rings
        of_0 = 4 * step  # its pseudonym
        assert film._equipped.get_array().filled(-1).tolist() == [of_0 / 16, 1 / 16, -1, -1]


def test_what_vehicles_last_detected_fabricated_and_believed_is_shown_until_they_sense_again(tmp_path):
    """Both sense every 5 steps: vehicle 0 in 3 and 8, vehicle 1 in 4 and 9. The pictures are of other steps.

    Vehicle 0 detects two objects in step 3 and believes in one, and none in step 8. Vehicle 1 fabricates one in step 4.
    """
    vehicles = fleet("honest", "malicious", sensing_interval_steps=5)
    vehicles[0]["sensing_phase_steps"], vehicles[1]["sensing_phase_steps"] = 3, 4
    detections = [
        {"step": 3, "observer": 0, "origin": "sensed", "x_m": 1.0},
        {"step": 3, "observer": 0, "detection_index": 1, "origin": "sensed", "x_m": 3.0},
        {"step": 4, "observer": 1, "origin": "fabricated", "x_m": 2.0},
        {"step": 4, "observer": 1, "detection_index": 1, "origin": "sensed", "x_m": 4.0},
    ]
    fused = [{"step": 3, "observer": 0, "source_index": 1}]
    run = make(tmp_path, 10, vehicles=vehicles, actors=[], detections=detections, fused=fused, trust=[])
    film = _Film(run, 0, np.array([2, 7, 8]), [], [])
    expected = ((2, [], [], []), (7, [1.0, 3.0], [2.0], [3.0]), (8, [], [2.0], []), (9, [], [], []))
    for step, finds, ghosts, beliefs in expected:
        film.show(step)
        drawn = [marks.get_offsets()[:, 0].tolist() for marks in (film._finds, film._ghosts, film._beliefs)]
        assert drawn == [finds, ghosts, beliefs], step


def test_on_a_full_disk_nothing_stays(tmp_path, monkeypatch):
    run = make(tmp_path, 2, vehicles=fleet("honest"), actors=[], detections=[], trust=[])
    monkeypatch.setattr(movie_figure.PillowWriter, "finish", full_disk)
    with pytest.raises(ValueError, match="cannot be written: No space left on device"):
        movie_figure.write(run, tmp_path / "m" / "m.gif", None, [], [])
    assert not list((tmp_path / "m").iterdir())
