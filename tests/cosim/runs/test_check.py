"""Notes before a run on what looks like a mistake."""

import numpy as np
import pytest

from cosim.config.config import load
from cosim.runs.check import check, notes_on
from cosim.runs.run import run
from results.archive import open_run
from tests.cosim.traffic import crossing
from tests.drive import noted
from tests.hostile.scenes import street_sets

SLOW = "radio.model=unit_disk", "radio.unit_disk.latency_max_s=0.3", "traffic.step_s=0.2", "sensing_phase=random"


def assert_noted(sets, about, said):
    """One note on this says so; there is none where `said` is empty."""
    notes = [note for note in noted(*sets) if about in note]
    assert [said in note for note in notes] == [True] * bool(said)


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        (("radio.range_m=1500",), "no frame arrives from farther than radio.propagation.interference_range_m = 1000 m"),
        (("radio.range_m=1500", "radio.model=nr_mode2"), "interference_range_m = 1000 m"),
        (("radio.range_m=1500", "radio.propagation.interference_range_m=2000"), ""),
        (("radio.range_m=1500", "radio.model=unit_disk"), ""),
        (SLOW, "latency_max_s = 0.3 s is longer than a round of 0.08 s"),
        ((*SLOW, "radio.timeout_s=0.5"), "whatever radio.timeout_s is"),
        ((*SLOW, "sensing_phase=common"), ""),
    ],
)
def test_messages_that_no_station_can_receive(sets, said):
    assert_noted(sets, "radio.", said)


@pytest.mark.parametrize(
    ("key", "form"),
    [
        ("objects.0.at_m", "[[objects]]\nat_m = [{}, {}]\n"),
        ("roadside.0.at", "[[roadside]]\nat = [{}, {}]\n"),
        ("rsu.at[0]", "[rsu]\nat = [[{}, {}, 6.0]]\n"),
    ],
)
def test_degrees_of_a_place_in_the_network_are_no_metres(tmp_path, key, form):
    """In either order. The metres are those of SUMO's convertGeo; degrees as metres are in a corner of the network."""
    path = tmp_path / "c.toml"
    for at in ((24.9444, 60.1714), (60.1714, 24.9444)):
        path.write_text(form.format(*at))
        with pytest.raises(ValueError, match=r"are degrees of a place in the network") as caught:
            check(load(path))
        east_m, north_m = map(float, str(caught.value)[:-2].rpartition("[")[2].split(","))
        assert str(caught.value).startswith(key)
        assert (east_m, north_m) == (525.2, 815.6)
    path.write_text(form.format(25.0, 62.0))
    check(load(path))


@pytest.mark.parametrize(("from_s", "said"), [(20, "because traffic.duration_s = 20 s"), (19.8, "")])
def test_an_object_that_never_appears_is_noted(from_s, said):
    sets = "traffic.duration_s=20", f"objects=[{{at_m=[300.0, 300.0], from_s={from_s}}}]"
    assert_noted(sets, f"objects.0.from_s = {from_s} s: the object never appears", said)


@pytest.mark.parametrize(("ground", "said"), [("", [24.0]), ("ground_m = 24.0\n", [])])
def test_an_object_below_a_hill_is_noted(tmp_path, ground, said):
    """A crossing at 24 m."""
    crossing.write(tmp_path, nodes=crossing.NODES.replace('y="', 'z="24" y="'))
    path = tmp_path / "c.toml"
    path.write_text(f'[traffic]\nscenario = "city.sumocfg"\n[[objects]]\nat_m = [200.0, 20.0]\n{ground}')
    config = load(path)
    notes = [note for note in notes_on(config, check(config)) if "objects.0.ground_m" in note]
    assert [float(note[:-1].rpartition(" = ")[2]) for note in notes] == said


def test_what_stands_in_a_building_is_noted(tmp_path):
    """The first block of houses is 20 to 180 m east and 20 to 130 m north, and 12 m high."""
    crossing.write(tmp_path, files="houses.poly.xml")
    (tmp_path / "houses.poly.xml").write_text(crossing.houses())
    objects = "[[objects]]\nat_m = [100.0, 50.0]\n[[objects]]\nat_m = [200.0, 50.0]\n"
    units = "[[roadside]]\nat = [100.0, 60.0]\n[[roadside]]\nat = [100.0, 70.0]\nheight_m = 12.5\n"
    path = tmp_path / "c.toml"
    path.write_text(f'[traffic]\nscenario = "city.sumocfg"\n{objects}{units}')
    config = load(path)
    noted = [note for note in notes_on(config, check(config)) if "inside a building" in note]
    assert [note.split(" is ")[0] for note in noted] == ["note: objects.0", "note: roadside/100.00/60.00"]


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        (("lidar.profile=vlp16",), "2 degrees apart. People more than 7 m"),  # 0.25 / 7.16 = tan 2 degrees
        (("lidar.profile=hdl64e",), ""),  # 0.33 to 0.5 degrees
        ((), ""),
        (("lidar.profile=vlp16", "area.gaps=unknown"), ""),
        (("lidar.profile=vlp16", "sensing=false"), ""),
    ],
)
def test_a_sparse_lidar_is_noted(sets, said):
    assert_noted(sets, "note: beams of the LiDAR are", said)


GHOSTS = "attacks.0.attack=ghost_insertion"


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        (("traffic.duration_s=20", GHOSTS, "attacks.1.start_s=5"), "attacks.0.start_s = 30 s: the attack never begins"),
        (("traffic.duration_s=30", GHOSTS, "attacks.1.start_s=5"), "because traffic.duration_s = 30 s"),
        (("traffic.duration_s=31", GHOSTS, "attacks.1.start_s=5"), ""),
        (("traffic.duration_s=20", "attacks.0.share_p=0", "attacks.1.start_s=5"), ""),
        (("traffic.duration_s=20", "attacks.0.start_s=1e8", "attacks.1.start_s=5"), ""),
        (("traffic.duration_s=20", "attacks.1.start_s=5", "sensing=false"), ""),
        (("traffic.duration_s=20",), ""),
    ],
)
def test_an_attack_that_never_begins_is_noted(sets, said):
    """Unless it has no attackers, is not meant to begin, or is one of the default run."""
    assert_noted(sets, "never begins", said)


@pytest.mark.parametrize(
    ("sets", "says"),
    [
        ("preset=modern trust.server_period_s=0.3", "0.3: the server broadcasts every 0.4 s"),
        ("preset=modern sensing_phase=common trust.server_period_s=0.5", "0.5: the server broadcasts every 1 s"),
        ("preset=modern trust.server_period_s=0.1", "0.1: the server broadcasts every 0.2 s"),
        ("preset=modern trust.server_period_s=1.4", ""),
        ("preset=modern", ""),
        ("preset=modern trust.host=local trust_variant=[] trust.server_period_s=0.3", ""),
    ],
)
def test_a_period_that_is_rounded_up_is_noted(sets, says):
    assert_noted(sets.split(), "broadcasts every", says)


def test_the_noted_period_is_that_of_the_run(tmp_path):
    sets = [*street_sets(tmp_path), "trust.server_period_s=1.5"]
    assert_noted(sets, "broadcasts every", "the server broadcasts every 2 s, because messages are exchanged every 1 s.")
    recorded = open_run(run(load(None, sets), tmp_path / "run", lambda *_: None))
    assert set(np.diff(np.unique(recorded.trust.step))) == {2}


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        ("radio.model=nr_mode2", "within a round of 0.04 s"),
        ("radio.model=nr_mode2 radio.sidelink.window_s=0.05", ""),
        ("radio.model=csma", ""),
        ("radio.model=lte_mode4 sensing_interval_s=1", ""),
    ],
)
def test_rounds_that_cut_the_window_of_a_sidelink_are_noted(sets, said):
    """At 10 Hz a round has 40 ms, and stations choose among 20 to 40 slots instead of 100."""
    at_10_hz = "sensing_interval_s=0.1", "traffic.step_s=0.1", "sensing_phase=common"
    assert_noted((*at_10_hz, *sets.split()), "radio.sidelink.window_s", said)


def test_without_compiled_code_nothing_runs(monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    with pytest.raises(ValueError, match="unset NUMBA_DISABLE_JIT"):
        check(load(None, []))
