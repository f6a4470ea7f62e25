"""Figures of a simulation of a city's demand."""

from cosim.addons.netbuild.flow import _flow

STEP = (
    '<step time="{}" running="{}" waiting="1" ended="{}" collisions="{}" teleports="{}" halting="0" meanSpeed="10.0"/>'
)


def test_events_of_the_warm_up_do_not_count(tmp_path):
    """SUMO counts from its begin: 7 - 4 trips, 3 - 1 collisions and 5 - 2 teleports are after 2 s of warm-up."""
    steps = [(0.0, 1, 2, 0, 1), (1.0, 5, 4, 1, 2), (2.0, 6, 4, 1, 2), (3.0, 8, 7, 3, 5)]
    (tmp_path / "summary.xml").write_text(f"<summary>{''.join(STEP.format(*step) for step in steps)}</summary>")
    found = _flow(tmp_path, 2.0, 2.0, {})
    assert (found.trips, found.collisions, found.teleports) == (3, 2, 3)
    assert (found.vehicles_mean, found.waiting) == (7.0, 1)
    whole = _flow(tmp_path, 0.0, 4.0, {})
    assert (whole.trips, whole.collisions, whole.teleports) == (7, 3, 5)
