"""What a trace of SUMO's means: its beat, its units and origin, its persons, its types, and who its actors are."""

import gzip
from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.base.earth import Projection
from cosim.traffic.frame import TrafficError
from cosim.traffic.georeference import NetLocation, conversion
from cosim.traffic.interpolation import interval_s
from cosim.traffic.params import TrafficParams
from cosim.traffic.remarks import trace_remarks
from cosim.traffic.replay import RunReplay, TraceReplay
from tests.cosim.traffic.worlds import collect, registry
from tests.results import tiny

COLUMNS = ("x", "y", "angle", "type", "speed")
FORMATS = ("xml", "csv", "parquet", "xml.gz", "csv.gz")


def write(tmp_path, rows, form="xml", times=None):
    """A trace of rows (time, id, x, y, angle, type, speed) in one of SUMO's formats; XML has empty timesteps, too."""
    path = tmp_path / f"trace.{form}"
    if form.startswith("xml"):
        times = sorted({row[0] for row in rows}) if times is None else times
        steps = []
        for t in times:
            inside = "".join(
                f'<{"person" if row[5] == "walker" else "vehicle"} id={quoteattr(row[1])} '
                + " ".join(f'{k}="{v}"' for k, v in zip(COLUMNS, row[2:], strict=True)) + "/>"
                for row in rows if row[0] == t
            )  # fmt: skip
            steps.append(f'<timestep time="{t}">{inside}</timestep>')
        data = f"<fcd-export>{''.join(steps)}</fcd-export>".encode()
        path.write_bytes(gzip.compress(data) if form.endswith("gz") else data)
        return path
    table = pd.DataFrame(rows, columns=["timestep_time", "vehicle_id", *(f"vehicle_{c}" for c in COLUMNS)])
    if form == "parquet":
        pq.write_table(pa.Table.from_pandas(table), path)
    else:
        table.to_csv(path, sep=";", index=False)
    return path


def replay(path, step_s=1.0, n=99, **more):
    """Actors by step: {name: x of the front bumper}; and the report."""
    who = registry()
    traffic = TraceReplay(TrafficParams(step_s=step_s), path, who, **more)
    worlds = collect(traffic, 0, n)
    found = [
        {who.names[a]: x for a, x in zip(w["actor"], w["xyz_m"][:, 0] + w["lwh_m"][:, 0] / 2, strict=True)}
        for w in worlds
    ]
    return found, traffic.report(), who


def file_of_cars(times):
    """Five cars in file at 10 m/s: x = 100 + 10 t + 30 k."""
    return [(t, f"c{k}", 100 + 10 * t + 30 * k, 5.0, 90.0, "car", 10.0) for t in times for k in range(5)]


BEATS = {
    "a period of 1 s becomes 2 s": [*range(12), *range(12, 23, 2)],
    "a clock that is 0.4 ms late per step": [*range(10), *(10 + k + 0.0004 * (k + 1) for k in range(12))],
    "a clock that is 3 ms early per step": [*range(5), *(5 + k - 0.003 * (k + 1) for k in range(17))],
    "one timestep is lost": [t for t in range(22) if t != 13],
    "a clock that is shifted by 0.3 s": [*range(11), *(t + 0.3 for t in range(11, 22))],
    "jitter from the beginning": [round(t + 0.02 * np.sin(7 * t), 3) for t in range(22)],
}


@pytest.mark.parametrize("form", FORMATS[:3])
@pytest.mark.parametrize("what", BEATS)
def test_no_car_vanishes_when_a_trace_loses_its_beat(tmp_path, what, form):
    found, _, _ = replay(write(tmp_path, file_of_cars(BEATS[what]), form))
    assert len(found) >= 21 and not found[0]
    begin = BEATS[what][0]
    for step, here in enumerate(found[1:]):
        assert here == pytest.approx({f"c{k}": 100 + 10 * (begin + step) + 30 * k for k in range(5)}, abs=0.02)


def test_a_lost_timestep_is_said_with_its_time(tmp_path):
    _, report, _ = replay(write(tmp_path, file_of_cars([t for t in range(22) if t != 13])))
    assert report["trace_lost"] == {"steps": 1, "first_s": 13}
    _, report, _ = replay(write(tmp_path, file_of_cars(range(22))))
    assert "trace_lost" not in report


@pytest.mark.parametrize("form", FORMATS[:3])
def test_a_long_gap_is_refused_with_its_time(tmp_path, form):
    path = write(tmp_path, file_of_cars([*range(8), *range(14, 20)]), form)
    with pytest.raises(TrafficError, match=r"no timestep between 7 s and 14 s, although 5 of 5 actors"):
        replay(path)


@pytest.mark.parametrize("form", FORMATS[:3])
def test_a_road_that_is_empty_stays_empty(tmp_path, form):
    """One car until 4 s, another one from 11 s on. CSV and Parquet have no rows in between."""
    rows = [(t, "a", 10.0 * t, 0.0, 90.0, "car", 10.0) for t in range(5)]
    rows += [(t, "b", 10.0 * (t - 11), 0.0, 90.0, "car", 10.0) for t in range(11, 15)]
    found, report, _ = replay(write(tmp_path, rows, form, times=range(15)))
    assert [len(here) for here in found] == [0] + [1] * 5 + [0] * 6 + [1] * 4 and "trace_lost" not in report


def test_the_interval_of_timesteps_by_hand():
    assert interval_s(np.arange(0, 1, 0.1)) == 0.1
    assert interval_s(np.array([0, 1, 2.0004, 3.0008])) == 1.0  # two digits, because it is not regular
    assert interval_s(np.array([0, 1, 2, 5, 6, 7])) == 1.0  # 3 s are a gap
    assert interval_s(np.array([0.03, 0.07, 0.1, 0.13])) == 0.033
    assert interval_s(np.zeros(1)) is None


MAP = Projection.of("+proj=utm +zone=35 +ellps=WGS84", 386_000.0, 6_672_000.0)
NET = NetLocation((0.0, 0.0, 600.0, 10.0), MAP, (-386_000.0, -6_672_000.0))


def test_degrees_and_map_coordinates_become_the_networks(tmp_path):
    """The same trace in metres of the network, of the map, and in degrees: one world."""
    rows = file_of_cars(range(12))
    plain, report, _ = replay(write(tmp_path, rows), net=NET)
    assert "trace_placed" not in report
    utm = [(t, n, x + 386_000, y + 6_672_000, *rest) for t, n, x, y, *rest in rows]
    there, report, _ = replay(write(tmp_path, utm), net=NET)
    assert there == plain and "--fcd-output.utm" in report["trace_placed"]
    # SUMO 1.28 leaves persons in the network's coordinates: one walks, and one rides in c1.
    persons = [(t, "p", 50.0 + t, 9.0, 90.0, "walker", 1.0) for t in range(12)]
    persons += [(t, "r", 130.0 + 10 * t, 5.0, 90.0, "walker", 10.0) for t in range(12)]
    for cars in (rows, utm):
        there, _, _ = replay(write(tmp_path, [*cars, *persons]), net=NET)
        assert [set(world) for world in there[1:]] == [{"p", *plain[1]}] * 12
        assert there[12]["p"] == pytest.approx(61.0, abs=0.01)
    places = MAP.of_world(np.array([row[2:4] for row in rows]))
    geo = [
        (t, n, lon, lat, *rest)
        for (t, n, _, _, *rest), lat, lon in zip(rows, places.latitude_deg, places.longitude_deg, strict=True)
    ]
    there, report, _ = replay(write(tmp_path, geo), net=NET)
    assert len(there) == len(plain) and "longitudes and latitudes" in report["trace_placed"]
    for a, b in zip(there, plain, strict=True):
        assert a == pytest.approx(b, abs=0.01)
    with pytest.raises(TrafficError, match=r"look like degrees\. Record the trace without --fcd-output.geo"):
        replay(write(tmp_path, geo))
    with pytest.raises(TrafficError, match=r"such as UTM\. No other one is read"):
        replay(write(tmp_path, geo), net=NetLocation(NET.bounds_m))  # of a map that is no such projection
    few = [row for row in geo if row[1] == "c0"][:4]  # three moves of one car are enough
    with pytest.raises(TrafficError, match="look like degrees"):
        replay(write(tmp_path, few))


def test_vehicles_far_from_all_lanes_are_noted(tmp_path):
    """One street along y = 0, 600 m long. Of nine cars, some drive on a footpath, 10.1 m off the street. Two are
    not noted, and three, a third, are. Pedestrians do not count."""
    lane = '<edge id="{0}"><lane id="{0}_0" index="0" {1} speed="9" length="600" shape="0.00,{2} 600.00,{2}"/></edge>'
    path = tmp_path / "net.net.xml"
    footpath = lane.format("b", 'allow="pedestrian"', 10.1)
    path.write_text(f"<net>{lane.format('a', '', 0)}{footpath}</net>")
    net = NetLocation((0.0, 0.0, 600.0, 10.1), path=path)
    for n_far, far_p in ((2, None), (3, 0.333), (4, 0.444), (9, 1.0)):
        rows = [
            (t, f"c{i}", 50 * i + t, 10.1 if i < n_far else -9.9 * (i % 2), 90, "car", 1)
            for t in range(4) for i in range(9)
        ]  # fmt: skip
        rows += [(t, f"p{i}", 50 * i + t, 40, 90, "walker", 1) for t in range(4) for i in range(9)]
        assert replay(write(tmp_path, rows), net=net)[1].get("trace_far_from_lanes_p") == far_p
    assert "trace_far_from_lanes_p" not in replay(write(tmp_path, rows), net=NET)[1]
    places = [{"step": 0, "actor": i, "x_m": 50 * i, "y_m": 40 * (i < 4)} for i in range(9)]
    run = tiny.make(tmp_path, 1, vehicles=tiny.fleet(*["honest"] * 9, vehicle_class="car"), actors=places)
    again = RunReplay(TrafficParams(step_s=1.0), run.path, registry(), net=net)
    again.advance()
    assert again.report()["trace_far_from_lanes_p"] == 0.444
    (said,) = trace_remarks({"trace_far_from_lanes_p": 0.444})
    assert said.startswith("note: 44% of the vehicles of the trace appear more than 10 m from all lanes")


@pytest.mark.parametrize(("begin_m", "end_m", "off_p"), [(1.9, 1.9, None), (2.1, 2.1, 1.0), (0, 6, 0.667)])
def test_vehicles_above_or_below_all_lanes_are_noted(tmp_path, begin_m, end_m, off_p):
    """A trace without z, of nine cars every 50 m from 75 m on. A street that climbs by 6 m over 600 m is less than
    2 m above the first three of them, at 75, 125 and 175 m."""
    shape = f"0,0,{begin_m} 600,0,{end_m}"
    path = tmp_path / "net.net.xml"
    path.write_text(f'<net><edge id="a"><lane id="a_0" index="0" speed="9" length="600" shape="{shape}"/></edge></net>')
    rows = [(t, f"c{i}", 75 + 50 * i + t, 1.0, 90, "car", 1) for t in range(4) for i in range(9)]
    net = NetLocation((0.0, 0.0, 600.0, 10.0), path=path)
    assert replay(write(tmp_path, rows), net=net)[1].get("trace_off_level_p") == off_p
    (said,) = trace_remarks({"trace_off_level_p": 0.667})
    assert said.startswith("note: 67% of the vehicles of the trace appear more than 2 m above or below the lanes")


def test_a_map_around_its_own_middle_needs_a_projection():
    own = Projection(60.0, 25.0)
    with pytest.raises(TrafficError, match="the network has no projection"):
        conversion("t", _timesteps(), NetLocation((0, 0, 9, 9)), own)
    assert conversion("t", _timesteps(), None, own) == (None, "")


def _timesteps():
    from cosim.traffic.fcd import Timestep

    return [Timestep(0.0, ["a"], [""], np.zeros((1, 3)), np.zeros(1), np.zeros(1), np.zeros(1, bool))]


@pytest.mark.parametrize(
    ("factor_s", "factor_m", "says"), [(1000, 1, "milliseconds"), (1, 0.001, "kilometres"), (1, 1000, "millimetres")]
)
def test_times_and_positions_in_other_units_are_refused(tmp_path, factor_s, factor_m, says):
    rows = [(t * factor_s, n, x * factor_m, y, *rest) for t, n, x, y, *rest in file_of_cars(range(12))]
    with pytest.raises(TrafficError, match=says):
        replay(write(tmp_path, rows))


def test_feet_are_noted(tmp_path):
    rows = [(t, n, x / 0.3048, y, *rest) for t, n, x, y, *rest in file_of_cars(range(12))]
    assert replay(write(tmp_path, rows))[1]["trace_travel_ratio"] == pytest.approx(3.28, abs=0.01)


@pytest.mark.parametrize(("unit_mps", "ratio"), [(0.44704, 0.447), (0.514444, 0.514)], ids=["mph", "knots"])
def test_speeds_in_miles_per_hour_or_knots_are_noted(tmp_path, unit_mps, ratio):
    rows = [(*row, speed / unit_mps) for *row, speed in file_of_cars(range(12))]
    assert replay(write(tmp_path, rows))[1]["trace_travel_ratio"] == pytest.approx(ratio, abs=0.001)


def crossing(angle_of):
    """Cars that drive east, north, west and south at 10 m/s; `angle_of` says the angle of a direction, 0 for east."""
    rows = []
    for t in range(12):
        for way, (east, north) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
            x, y = 20 * way + 10 * t * east, 20 * way + 10 * t * north
            rows.append((t, f"c{way}", x, y, angle_of(90 * way), "car", 10.0))
    return rows


def test_angles_that_are_not_clockwise_from_north_in_degrees_are_noted(tmp_path):
    said = {}
    for name, angle_of in {
        "compass": lambda deg: (90 - deg) % 360,
        "from east": lambda deg: deg,
        "radians": lambda deg: np.deg2rad((90 - deg) % 360),
        "to the rear": lambda deg: (270 - deg) % 360,
    }.items():
        said[name] = replay(write(tmp_path, crossing(angle_of)))[1].get("trace_aside_p")
    # In radians, angles are near 0: three of the four do not go north.
    assert said == {"compass": None, "from east": 1.0, "radians": 0.75, "to the rear": 1.0}
    (note,) = trace_remarks({"trace_aside_p": 0.75})
    assert "75%" in note and "clockwise from north" in note


def test_who_reverses_does_not_stand(tmp_path):
    """A negative speed is that of reversing, and is no direction on a map, beside an angle that says it already."""
    for angle_deg, aside_p in ((270.0, None), (90.0, 1.0)):
        rows = [(*row, angle_deg, kind, -speed) for *row, _, kind, speed in file_of_cars(range(12))]
        report = replay(write(tmp_path, rows))[1]
        assert report["vehicles_standing_p"] == 0.0 and report.get("trace_aside_p") == aside_p


def test_mesoscopic_traffic_and_a_single_leap_are_no_other_units(tmp_path):
    """Vehicles of SUMO's mesoscopic model stand at the begin of a segment and then leap; the mean way is right."""
    meso = [(t, n, 50 * (x // 50), y, *rest) for t, n, x, y, *rest in file_of_cars(range(30))]
    assert "trace_travel_ratio" not in replay(write(tmp_path, meso))[1]
    leap = [(t, n, x + (900 if (t, n) == (4, "c2") else 0), y, *rest) for t, n, x, y, *rest in file_of_cars(range(9))]
    assert "trace_travel_ratio" not in replay(write(tmp_path, leap))[1]


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("kind", ["another type", "far away", "a person"])
def test_a_name_that_comes_back_elsewhere_is_another_actor(tmp_path, kind, form):
    first, second, far_m = {"another type": ("car", "truck_trailer", 60), "far away": ("car", "car", 8800),
                            "a person": ("DEFAULT_PEDTYPE", "DEFAULT_PEDTYPE", 8800)}[kind]  # fmt: skip
    rows = [(t, "7", 100 + 10 * t, 5, 90, first, 10) for t in range(3)]
    rows += [(t, "7", 100 + far_m + 10 * t, 5, 90, second, 10) for t in range(8, 12)]
    rows += [(t, "8", 110 + 10 * t, 5, 90, "car", 10) for t in range(12)]
    found, report, who = replay(write(tmp_path, sorted(rows, key=lambda row: row[0]), form))
    assert sorted(who.names) == ["7", "7/2", "8"] and report["names_again"] == {"n": 1, "first": "7/2"}
    assert [sorted(here) for here in found[1:]] == [["7", "8"]] * 3 + [["8"]] * 5 + [["7/2", "8"]] * 4
    if kind == "another type":
        assert who.lwh_m[who.names.index("7/2"), 0] == 16.5 and who.lwh_m[who.names.index("7"), 0] == 5.0


@pytest.mark.parametrize("form", FORMATS[:3])
def test_a_short_absence_and_a_copied_type_are_the_same_vehicle(tmp_path, form):
    """Three timesteps away, on where its speed leads, with a type that SUMO copied for it by TraCI."""
    rows = [(t, "5", 8 * t, 5, 90, "car" if t < 4 else "car@5", 8) for t in range(14) if t not in (5, 6, 7)]
    rows += [(t, "6", 8 * t + 30, 5, 90, "car", 8) for t in range(14)]
    _, report, who = replay(write(tmp_path, sorted(rows, key=lambda row: row[0]), form))
    assert sorted(who.names) == ["5", "6"] and "names_again" not in report
    assert dict(zip(who.names, who.n_steps.tolist(), strict=True)) == {"5": 11, "6": 14}


def test_a_vehicle_that_sumo_teleports_is_the_same(tmp_path):
    """It stands for a while, is gone for two seconds and comes back behind the next junction, 300 m ahead."""
    rows = [(t, "5", 50.0, 5, 90, "car", 0) for t in range(5)] + [(7, "5", 350.0, 5, 90, "car", 3)]
    rows += [(t, "6", 8 * t, 5, 90, "car", 8) for t in range(9)]
    assert sorted(replay(write(tmp_path, sorted(rows, key=lambda row: row[0])))[2].names) == ["5", "6"]


def test_types_of_files_come_before_guesses_also_for_one_vehicle(tmp_path):
    (tmp_path / "types.rou.xml").write_text(
        '<routes><vType id="lorry18" vClass="truck" length="18" width="2.5" height="4"/><vTypeDistribution id="mix">'
        '<vType id="equipped" vClass="coach" length="13.2"/></vTypeDistribution></routes>'
    )
    types = {"a": "lorry18@a", "b": "lorry18", "c": "equipped@c@d", "d": "VANET"}
    rows = [(t, name, 20.0 * k, 0, 90, of, 0) for t in range(3) for k, (name, of) in enumerate(types.items())]
    _, report, who = replay(write(tmp_path, rows), files=(tmp_path / "types.rou.xml",))
    sizes = dict(zip(who.names, who.lwh_m[:, 0].tolist(), strict=True))
    assert sizes == pytest.approx({"a": 18, "b": 18, "c": 13.2, "d": 5}) and report["types_guessed"] == {
        "VANET": "passenger"
    }


def test_persons_without_a_type_are_persons_and_riders_are_left_out(tmp_path):
    """SUMO before 1.21 and chosen attributes; a person at the place of a vehicle rides in it."""
    rows = "".join(
        f'<timestep time="{t}"><vehicle id="bus" x="{6 * t}" y="0" angle="90" speed="6"/>'
        f'<person id="rider" x="{6 * t}" y="0" angle="90" speed="6"/>'
        f'<person id="bus" x="{6 * t}" y="9" angle="90" speed="1"/></timestep>'
        for t in range(4)
    )
    (tmp_path / "t.xml").write_text(f"<fcd-export>{rows}</fcd-export>")
    _, report, who = replay(tmp_path / "t.xml")
    assert who.names == ["bus", "bus"] and who.shape.tolist() == [0, 6] and not who.equipped[1]
    assert report["vehicles_without_type"] == 1


@pytest.mark.parametrize(
    ("head", "rows", "shapes"),
    [  # columns of each kind, as xml2csv writes them; a person is on an edge and on no lane, as SUMO writes it,
        # and in mesoscopic traffic vehicles are so, too
        ("timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_speed;person_id;person_x;person_y;"
         "person_angle;person_speed", ["{t};v;{x};0;90;8;;;;;", "{t};;;;;;p;3;{t};0;1"], {"v": 0, "p": 6}),
        ("timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_speed;vehicle_lane;vehicle_edge",
         ["{t};v;{x};0;90;8;ab_0;", "{t};p;3;{t};0;1;;ab"], {"v": 0, "p": 6}),
        ("timestep_time;person_id;person_x;person_y;person_angle;person_speed", ["{t};p;3;{t};0;1"], {"p": 6}),
        ("timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_speed;vehicle_type;vehicle_lane;"
         "vehicle_edge", ["{t};v;{x};0;90;8;car;;ab", "{t};p;3;{t};0;1;DEFAULT_PEDTYPE;;ab"], {"v": 0, "p": 6}),
    ],
)  # fmt: skip
def test_persons_in_tables(tmp_path, head, rows, shapes):
    text = "\n".join([head, *(row.format(t=t, x=8 * t) for t in range(4) for row in rows)])
    (tmp_path / "t.csv").write_text(text + "\n")
    who = replay(tmp_path / "t.csv")[2]
    assert dict(zip(who.names, who.shape.tolist(), strict=True)) == shapes


@pytest.mark.parametrize("kind", ["DEFAULT_CONTAINERTYPE", "crate", ""])
def test_containers_in_xml_are_left_out_and_counted(tmp_path, kind):
    """As in tables, where SUMO writes them into the columns of vehicles."""
    what = 'id="{}" x="{}" y="0" angle="90" speed="0" type="{}"/>'
    car, box = "<vehicle " + what.format("a", 5, "car"), "<container " + what.format("b", 9, kind)
    path = tmp_path / "fcd.xml"
    path.write_text(f'<fcd-export><timestep time="0">{car}{box}</timestep></fcd-export>')
    worlds, report, _ = replay(path)
    assert list(worlds[-1]) == ["a"] and report["actors_left_out"] == {"container": 1}
    path.write_text(path.read_text().replace('x="5" y="0"', 'x="386005" y="6672000"'))  # as --fcd-output.utm does
    assert replay(path, net=NET)[0] == worlds


def test_columns_named_after_a_person_may_hold_vehicles(tmp_path):
    """SUMO names all columns after its first element; without types nobody can tell."""
    head = "timestep_time;person_id;person_x;person_y;person_angle;person_speed\n"
    (tmp_path / "t.csv").write_text(head + "0;p;3;0;0;1\n0;v;0;0;90;14\n")
    with pytest.raises(TrafficError, match="vehicles and persons cannot be told apart"):
        replay(tmp_path / "t.csv")


@pytest.mark.parametrize("form", FORMATS[:3])
def test_times_of_day(tmp_path, form):
    """SUMO's --human-readable-time; days come first."""
    clock = ["0:23:59:58", "0:23:59:59", "1:00:00:00", "1:00:00:01"]
    rows = [(t, "a", 10.0 * k, 0, 90, "car", 10) for k, t in enumerate(clock)]
    found, _, _ = replay(write(tmp_path, rows, form, times=clock))
    assert [here.get("a") for here in found] == [None, 0, 10, 20, 30]


def test_sizes_and_classes_that_a_trace_states(tmp_path):
    """Those of an export of cosim; types of the same name come after them."""
    rows = "".join(
        f'<timestep time="{t}"><vehicle id="a" type="bus" vClass="passenger" length="2.5" width="1.4" height="1.3" '
        f'x="{5 * t}" y="0" angle="90" speed="5"/></timestep>' for t in range(3)
    )  # fmt: skip
    (tmp_path / "t.xml").write_text(f"<fcd-export>{rows}</fcd-export>")
    _, report, who = replay(tmp_path / "t.xml")
    assert who.lwh_m[0] == pytest.approx([2.5, 1.4, 1.3]) and who.shape.tolist() == [0]
    assert "types_guessed" not in report and "vehicles_without_type" not in report
    (tmp_path / "t.xml").write_text(f"<fcd-export>{rows.replace('2.5', '2500')}</fcd-export>")
    with pytest.raises(TrafficError, match="'a' has length = 2500 m"):
        replay(tmp_path / "t.xml")


def test_a_type_that_traci_changes_makes_no_other_vehicle_between_timesteps(tmp_path):
    """The type changes without an absence, and steps are shorter than the trace's."""
    rows = [(t, "5", 8 * t, 5, 90, "car" if t < 4 else "slow_car", 8) for t in range(8)]
    assert replay(write(tmp_path, rows), step_s=0.25)[2].names == ["5"]
