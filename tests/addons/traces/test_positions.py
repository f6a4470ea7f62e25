"""Tables of positions: every layout by its columns, and every bad table told in one line."""

import gzip
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.addons.traces import units
from cosim.addons.traces.layouts import PositionColumns, layout_of
from cosim.addons.traces.positions import read
from cosim.traffic.source import TrafficError

TAXIS = """\
156;2014-02-01 00:00:00.739166+01;POINT(41.88367183 12.48777756)
187;2014-02-01 00:00:01+01;POINT(41.92854333 12.46903667)
156;2014-02-01 00:00:08.739166+01;POINT(41.88457183 12.48777756)
"""
HIGHD = "frame,id,x,y,width,height,xVelocity\n1,7,100,20,4,2,30\n2,7,101.2,20,4,2,30\n"
IND = "recordingId,trackId,frame,xCenter,yCenter\n0,3,0,5.0,6.0\n0,3,25,7.0,6.0\n"
OPENDD = "TIMESTAMP,OBJID,UTM_X,UTM_Y,CLASS\n10.0,1,600000.0,5700000.0,Bus\n10.5,1,600005.0,5700000.0,Bus\n"
INTERACTION = "track_id,frame_id,timestamp_ms,agent_type,x,y\n1,1,100,car,1000,900\n1,2,200,car,1001,900\n"


@pytest.fixture
def given(tmp_path):
    """What is read from a file of this name and text."""

    def found(name, text, **options):
        (tmp_path / name).write_text(text)
        return read([tmp_path / name], **options)

    return found


def test_taxis_of_crawdad(given):
    fixes = given("taxi.txt", TAXIS)
    assert fixes.names == ["156", "187"]
    np.testing.assert_allclose(fixes.time_s, [0, 8, 0.260834], atol=1e-6)
    # 0.0009 degrees of latitude are 0.0009 * 111.07 km = 99.96 m at 41.9 degrees; east does not change.
    step = fixes.xy_m[1] - fixes.xy_m[0]
    np.testing.assert_allclose(step, [0, 99.96], atol=0.05)
    assert fixes.begin == "1391209200.739166"  # 2014-01-31 23:00:00.739166 UTC


@pytest.mark.parametrize(
    ("name", "text", "layout", "time_s", "xy_m"),
    [("t.csv", HIGHD, "highd", [0, 0.04], [[102, -21], [103.2, -21]]),  # the corner, and half of 4 m x 2 m; y is down
     ("03_tracks.csv", IND, "ind", [0, 1.0], [[5, 6], [7, 6]]),
     ("d.csv", OPENDD, "opendd", [0, 0.5], [[600000, 5700000], [600005, 5700000]]),
     ("i.csv", INTERACTION, "interaction", [0, 0.1], [[1000, 900], [1001, 900]])],
)  # fmt: skip
def test_trajectories_of_drones(tmp_path, given, name, text, layout, time_s, xy_m):
    (tmp_path / "03_recordingMeta.csv").write_text("recordingId,frameRate\n3,25\n")
    fixes = given(name, text, frame_hz=25.0 if layout == "highd" else None)
    assert layout_of(tmp_path / name) == layout
    np.testing.assert_allclose(fixes.time_s, time_s, atol=1e-9)
    np.testing.assert_allclose(fixes.xy_m, xy_m)
    assert fixes.kinds == [{"opendd": "Bus", "interaction": "car"}.get(layout, "")]


def test_one_table_in_every_form(tmp_path):
    rows = {"id": ["a", "b", "a"], "time": [0.0, 0.0, 1.0], "x": [1.0, 50.0, 3.0], "y": [2.0, 0.0, 2.0]}
    pq.write_table(pa.table(rows), tmp_path / "t.parquet")
    text = "id,time,x,y\na,0,1,2\nb,0,50,0\na,1,3,2\n"
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(text.encode()))
    (tmp_path / "one.csv").write_text("id;time;x;y\na;0;1;2\n")
    (tmp_path / "two.csv").write_text("id;time;x;y\nb;0;50;0\na;1;3;2\n")
    dated = text.replace(",0,", ",2026-01-01 00:00:00,").replace("a,1,", "a,2026-01-01T00:00:01Z,")
    (tmp_path / "dates.csv").write_text(dated.replace("b,2026-01-01 00:00:00,50,0", "b,2026-01-01 00:00:00,50,0"))
    named = PositionColumns("id", "time", "x", "y")
    found = [read([tmp_path / "t.parquet"]), read([tmp_path / "t.csv.gz"]), read([tmp_path / "t.csv.gz"], named),
             read([tmp_path / "one.csv", tmp_path / "two.csv"])]  # fmt: skip
    for fixes in found:
        assert fixes.names == ["a", "b"]
        np.testing.assert_array_equal(fixes.actor, [0, 0, 1])
        np.testing.assert_array_equal(fixes.time_s, [0, 1, 0])
        np.testing.assert_array_equal(fixes.xy_m, [[1, 2], [3, 2], [50, 0]])


HEAD = "id,time,x,y\n"
BAD = {
    "empty": ("", "no layout that is known by its columns (empty)"),
    "no rows": (HEAD, "no position in it"),
    "other columns": ("who,when,east,north\na,0,1,2\n", "no layout that is known by its columns (columns who, when"),
    "missing": (HEAD + "a,0,1,2\na,1,,2\n", "row 2 ('a') has a value missing or not finite, and 1 of 2 rows do"),
    "nan": (HEAD + "a,0,1,2\na,1,nan,2\n", "row 2 ('a') has a value missing"),
    "infinite": (HEAD + "a,0,1,2\na,1,inf,2\n", "row 2 ('a') has a value missing"),
    "no name": (HEAD + ",0,1,2\n", "row 1"),
    "unordered": (HEAD + "a,1,1,2\na,0,3,2\n", "the rows of 'a' are not in the order of time"),
    "twice": (HEAD + "a,0,1,2\na,0,3,2\n", "'a' has two positions at the time 0 s"),
    "words": (HEAD + "a,0,here,2\n", "column x holds something that is not a number"),
    "time in words": (HEAD + "a,now,1,2\n", "holds 'now', which is neither a number of seconds nor a date"),
    "time in Arabic digits": (HEAD + "a,\u0661:00:00,1,2\n", "which is neither a number of seconds"),
    "degrees as metres": (HEAD + "a,0,12.4877,41.8836\na,10,12.4879,41.8838\n", "so x and y look like degrees"),
    "kilometres": (HEAD + "a,0,612.1,5700\na,1,612.11,5700\n", "so x and y look like kilometres"),
    "no header": ("a,0,1,2\na,1,2,2\n", "no header line: it begins with a, 0, 1, 2. Put a line with the names"),
    "no header but dates": ("7;2024-05-06 08:00:00;13.4;52.5\n", "no header line: it begins with 7, 2024-05-06"),
    "thousands": ("id;time;x;y\na;0;1,234,567;2\n", "'1,234,567' in row 1. Are commas or points between thousands"),
    "points and commas": ("id;time;x;y\na;0;1.5;2\na;1;2,5;2\n", "'2,5' in row 2. Is it a decimal comma"),
    "frames by name": ("id,frame,x,y\na,0,1,2\n", "no layout that is known"),
    "no place": (HEAD + "a,0,1e12,2\n", "no place on Earth"),
    "column twice": ("id,time,x,x,y\na,0,1,1,2\n", "column x twice"),
    "ragged": (HEAD + "a,0,1,2\na,1,2\n", "a row has 3 values and the header has 4 names"),
    "taxi without a place": ("1;2014-02-01 00:00:00+01;POINT(41.8 12.4)\n1;2014-02-01 00:00:09+01;POINT()\n",
                             "line 2 has no POINT"),
    "frames of unknown length": (HIGHD, "Set --frame-hz"),
    "sizes of a box in space": ("frame,id,x,y,length,width,height\n1,a,0,0,4,2,1\n", "no layout that is known"),
    "latitude of metres": ("id,time,lat,lon\na,0,600000,5700000\n", "Are they metres?"),
    "other way round": ("id,time,lat,lon\na,0,139.7,35.6\n", "the other way round?"),
    "round the world": ("id,time,lat,lon\na,0,41,12\nb,0,-41,100\n", "from their median"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_a_bad_table_is_told_in_one_line(given, what):
    text, said = BAD[what]
    with pytest.raises(TrafficError) as caught:
        given("t.csv", text)
    assert said in str(caught.value) and "t.csv" in str(caught.value) and "\n" not in str(caught.value)


def test_texts_of_tables_by_hand(given):
    """Blanks after commas, quotes, decimal commas, a mark of byte order, carriage returns: one table."""
    texts = [
        "id, time, x, y\na, 0, 1.5, 2\n a, 1, 3.5, 2\nb, 0, 50, 0\n",
        '"id";"time";"x";"y"\n"a";0;"1,5";2,0\n"a";1;"3,5";2,0\n"b";0;50;0\n',
        "\ufeffid\ttime\tx\ty\r\na\t0\t1,5\t2\r\na\t1\t3,5\t2\r\nb\t0\t50\t0",
        "id|time|x|y\na|00:00:00|1.5|2\na|00:00:01|3.5|2\nb|00:00:00|50|0\n",
        "id,time,x,y\na,0,1.5,2,\na,1,3.5,2,\nb,0,50,0,\n",
        "id,time,x,y,\na,0,1.5,2,\na,1,3.5,2,\nb,0,50,0,\n",
        "id time  x y\n a 0   1.5 2 \na 1 3.5 2\nb 0 50 0\n",
        "id,time,x,y\na,1163065600000,1.5,2\na,1163065601000,3.5,2\nb,1163065600000,50,0\n",
    ]
    for n, text in enumerate(texts):
        fixes = given(f"t{n}.csv", text)
        assert fixes.names == ["a", "b"], text
        np.testing.assert_array_equal(fixes.time_s, [0, 1, 0])
        np.testing.assert_array_equal(fixes.xy_m, [[1.5, 2], [3.5, 2], [50, 0]])


def test_pneuma_has_a_row_per_vehicle(given):
    """Four values of the vehicle, then six per instant; 0.0001 degrees of latitude are 11.1 m."""
    head = "track_id; type; traveled_d; avg_speed; lat; lon; speed; lon_acc; lat_acc; time\n"
    rows = "1; Car; 9; 9; 37.97; 23.73; 40; 0; 0; 0; 37.9701; 23.73; 40; 0; 0; 1; \n"
    rows += "2; Bus; 9; 9; 37.98; 23.73; 0; 0; 0; 0.5\n"
    fixes = given("p.csv", head + rows)
    assert fixes.names == ["1", "2"] and fixes.kinds == ["Car", "Bus"] and fixes.time_s.tolist() == [0, 1, 0.5]
    assert fixes.xy_m[1, 1] - fixes.xy_m[0, 1] == pytest.approx(11.1, abs=0.01)
    with pytest.raises(TrafficError, match="row 1 has 11 values"):
        given("q.csv", head + "1; Car; 9; 9; 37.97; 23.73; 40; 0; 0; 0; 37\n")
    with pytest.raises(TrafficError, match=r"is read by itself\. Leave out --id"):
        given("r.csv", head + rows, columns=PositionColumns("track_id", "time", "lat", "lon", is_degrees=True))


NGSIM = "Vehicle_ID,Global_Time,Local_X,Local_Y,v_Length,v_Width,v_Class,v_Vel\n" + "".join(
    f"1,{1163065600000 + 100 * k},16.8,{100 + 4 * k},60,8,3,40\n" for k in range(5)
)


@pytest.mark.parametrize("columns", [None, PositionColumns("Vehicle_ID", "Global_Time", "Local_X", "Local_Y")])
def test_ngsim_is_in_feet_and_milliseconds(given, columns):
    """4 ft in 0.1 s are 12.192 m/s; NGSIM's class 3 is a truck, here of 60 ft = 18.288 m."""
    fixes = given("n.csv", NGSIM, columns=columns)
    np.testing.assert_allclose(np.diff(fixes.xy_m[:, 1]) / np.diff(fixes.time_s), 12.192, rtol=1e-5)
    if columns is None:
        (kind,) = fixes.types
        assert kind.vclass == "truck" and kind.lwh_m[:2] == pytest.approx((18.288, 8 * 0.3048))
    assert "ngsim" in fixes.read_as[0] or any("in ft" in said for said in fixes.read_as)


ALL_SITES = "Vehicle_ID,Total_Frames,Global_Time,Local_X,Local_Y,v_length,v_Width,v_Class,Location\n"
"""The columns of the file of all sites of NGSIM, as far as they are read."""


@pytest.mark.parametrize("head", [ALL_SITES, ALL_SITES.lower()])
def test_ngsim_of_all_sites(given, head):
    """Vehicle 1 of the second period enters 20 s after that of the first has left, 2,000 ft before: at 30 m/s."""
    rows = [f"1,3,{100 * k},16.8,{2000 + 4 * k},60,8,3,i-80\n" for k in range(3)]
    rows += [f"1,2,{20_200 + 100 * k},16.8,{4 * k},15,6,2,i-80\n" for k in range(2)]
    fixes = given("n.csv", head + "".join(rows))
    assert fixes.names == ["1:2", "1:3"] and np.bincount(fixes.actor).tolist() == [2, 3]
    np.testing.assert_allclose(fixes.own_lw_m, 0.3048 * np.array([[15, 6], [60, 8]]))
    with pytest.raises(TrafficError, match=r"says i-80, us-101: each has coordinates.*Keep the rows of one"):
        given("m.csv", head + "".join(rows) + "2,1,0,0,0,15,6,2,us-101\n")


METRES = [("a", t, 12.0 * t, 0.0, 12.0) for t in range(6)]


@pytest.mark.parametrize(
    ("time", "length", "factor_s", "factor_m"),
    [
        ("ms", "m", 1e3, 1),
        ("us", "m", 1e6, 1),
        ("min", "m", 1 / 60, 1),
        ("s", "ft", 1, 1 / 0.3048),
        ("s", "km", 1, 1e-3),
    ],
)
def test_units_are_asked_for_where_speeds_deny_them_and_are_obeyed(given, time, length, factor_s, factor_m):
    text = "id,time,x,y,speed\n" + "".join(f"{i},{t * factor_s},{x * factor_m},{y},{v}\n" for i, t, x, y, v in METRES)
    with pytest.raises(TrafficError, match=r"Set both units|--length-unit|--time-unit"):
        given("t.csv", text)
    fixes = given("t.csv", text, time_unit_s=units.TIME_S[time], length_unit_m=units.LENGTH_M[length])
    np.testing.assert_allclose(fixes.time_s, range(6), atol=1e-9)
    np.testing.assert_allclose(fixes.xy_m[:, 0], 12.0 * np.arange(6))


def test_speeds_in_other_units_are_no_evidence(given):
    for per in (1.0, 3.6, 2.237, 1.944, 3.281):
        text = "id,time,x,y,speed\n" + "".join(f"{i},{t},{x},{y},{v * per}\n" for i, t, x, y, v in METRES)
        assert given("t.csv", text).xy_m[1, 0] == 12


def test_a_map_that_stretches_is_told_by_speeds(given):
    """10 m/s at 50 degrees north are 15.6 m/s in web Mercator, whose scale is 1 / cos 50 degrees."""
    for scale, said in ((1.556, True), (1.0, False), (1.1, False)):
        rows = "".join(f"a,{t},{2_000_000 + 10 * scale * t},6400000,10\n" for t in range(30))
        read_as = given("t.csv", f"id,time,x,y,speed\n{rows}").read_as
        assert any("move 1.56 times as fast as the table says" in word for word in read_as) == said


def test_columns_whose_names_say_another_unit(given):
    text = "id,time_ms,x_ft,y_ft,frame,lon\na,0,10,20,0,1\na,100,20,20,1,1\n"
    fixes = given("t.csv", text, columns=PositionColumns("id", "time_ms", "x_ft", "y_ft"))
    assert fixes.time_s.tolist() == [0, 0.1] and fixes.xy_m[1, 0] == pytest.approx(6.096)
    city_sim = text.replace("x_ft,y_ft", "carCenterXft,carCenterYft")
    fixes = given("c.csv", city_sim, columns=PositionColumns("id", "time_ms", "carCenterXft", "carCenterYft"))
    assert fixes.xy_m[1, 0] == pytest.approx(6.096)
    with pytest.raises(TrafficError, match=r"named as frame numbers\. Set --frame-hz"):
        given("t.csv", text, columns=PositionColumns("id", "frame", "x_ft", "y_ft"))
    with pytest.raises(TrafficError, match="the column lon is named as degrees"):
        given("t.csv", text, columns=PositionColumns("id", "time_ms", "lon", "y_ft"))


@pytest.mark.parametrize("time", ["timestep", "time_step"])
def test_numbers_of_steps_are_no_seconds(given, time):
    """Argoverse's parquet files have ten steps per second: 1 m in each is 10 m/s."""
    head = f"track_id,{time},position_x,position_y,velocity_x,velocity_y\n"
    text = head + "".join(f"a,{k},{k},0,10,0\n" for k in range(4))
    named = PositionColumns("track_id", time, "position_x", "position_y")
    with pytest.raises(TrafficError, match=r"named as frame numbers\. Set --frame-hz"):
        given("t.csv", text, columns=named)
    with pytest.raises(TrafficError, match=r"0\.1 times the speeds that the table says"):
        given("t.csv", text, columns=named, time_unit_s=1.0)
    fixes = given("t.csv", text, columns=replace(named, is_frame=True), frame_hz=10.0)
    np.testing.assert_allclose(fixes.time_s, [0, 0.1, 0.2, 0.3])


def test_classes_and_sizes_beside_a_recording(tmp_path, given):
    """inD gives pedestrians a size of zero, which is none; highD's width is along the road, and its y points down."""
    (tmp_path / "03_recordingMeta.csv").write_text("recordingId,frameRate\n3,25\n")
    (tmp_path / "03_tracksMeta.csv").write_text("trackId,class\n0,car\n1,truck_bus\n2,pedestrian\n3,bicycle\n")
    rows = "".join(f"{k},{f},{9 * k},0,{w},{length}\n" for k, w, length in
                   ((0, 1.9, 4.6), (1, 2.5, 11.8), (2, 0, 0), (3, 0.7, 1.8)) for f in (0, 25))  # fmt: skip
    fixes = given("03_tracks.csv", "trackId,frame,xCenter,yCenter,width,length\n" + rows)
    assert [t.vclass for t in fixes.types] == ["passenger", "truck", "pedestrian", "bicycle"]
    assert fixes.read_as == ("layout ind",)
    alone = given("09_tracks.csv", "trackId,frame,xCenter,yCenter\n2,0,0,0\n2,25,1,0\n", frame_hz=25.0)
    assert alone.types[0].vclass == "passenger" and "no tracksMeta file beside it" in alone.read_as[-1]
    sizes = np.array([t.lwh_m[:2] for t in fixes.types])
    np.testing.assert_allclose(sizes, [[4.6, 1.9], [11.8, 2.5], [0.215, 0.478], [1.8, 0.7]])
    (tmp_path / "04_recordingMeta.csv").write_text("id,frameRate\n4,25\n")
    (tmp_path / "04_tracksMeta.csv").write_text("id,class\n7,Truck\n")
    fixes = given("04_tracks.csv", "frame,id,x,y,width,height\n1,7,100,20,16.5,2.5\n2,7,101,20,16.5,2.5\n")
    assert fixes.types[0].vclass == "truck" and fixes.types[0].lwh_m[:2] == (16.5, 2.5)
    assert fixes.xy_m[0].tolist() == [108.25, -21.25]


def test_what_is_no_table_is_told_in_one_line(tmp_path):
    (tmp_path / "t.parquet").write_bytes(b"PAR1 but no more")
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(TAXIS.encode())[:-9])
    for path in (tmp_path / "t.parquet", tmp_path / "t.csv.gz", tmp_path):
        with pytest.raises(ValueError) as caught:
            read([path])
        assert "\n" not in str(caught.value)


def test_repair_says_what_it_did(given):
    text = HEAD + "a,2,30,0\na,0,10,0\na,1,20,0\na,1,99,0\nb,,1,1\nb,0,5,5\nb,0,5,5\n"
    fixes = given("t.csv", text, repair=True)
    assert fixes.repaired == {"missing": 1, "repeated": 2, "unordered": 1}
    np.testing.assert_array_equal(fixes.xy_m[:, 0], [10, 20, 30, 5])


def test_what_sorting_does_not_mend_is_no_matter_of_repair(given):
    """Two drive side by side under one id, 50 m apart; and times of day go over midnight."""
    two = "".join(f"a,{t + lag},{10 * t},{50 * lag}\n" for lag in (0, 0.5) for t in range(20))
    clocks = ("23:59:58", "23:59:59", "00:00:00", "00:00:01")
    night = "".join(f"a,{clock},{10 * n},0\n" for n, clock in enumerate(clocks))
    for repair in (False, True):
        with pytest.raises(TrafficError, match="several vehicles at once"):
            given("two.csv", HEAD + two, repair=repair)
        with pytest.raises(TrafficError, match=r"fall by 86399 s: .* midnight"):
            given("night.csv", HEAD + night, repair=repair)


def test_an_id_that_is_given_again_to_another_class_is_another_actor(given):
    """A car until 3 s, a pedestrian 900 m away from 4 s on. Without a break, the most frequent class counts."""
    car = "".join(f"1,{t},{10 * t},0,car,4\n" for t in range(4))
    walker = "".join(f"1,{t},900,{t},pedestrian,0.3\n" for t in range(4, 8))
    columns = PositionColumns("id", "time", "x", "y")
    fixes = given("t.csv", "id,time,x,y,class,length\n" + car + walker + "2,0,0,9,bus,9\n", columns=columns)
    assert fixes.names == ["1", "2", "1/2"] and fixes.kinds == ["car", "bus", "pedestrian"]
    assert fixes.actor.tolist() == [0] * 4 + [1] + [2] * 4 and "1 ids come back" in fixes.read_as[0]
    assert [kind.lwh_m[0] for kind in fixes.types] == [4, 9, 0.3]
    flickers = "".join(f"1,{t},{10 * t},0,{'van' if t == 2 else 'car' if t else ''},4\n" for t in range(6))
    fixes = given("f.csv", "id,time,x,y,class,length\n" + flickers)
    assert fixes.kinds == ["car"] and "classes of 1 actors change" in fixes.read_as[0]


def test_what_is_read_otherwise_than_one_may_think_is_said(given):
    """Heights; a length without a width; sizes in feet; units of x and y that differ; six classes that are guessed."""
    columns = PositionColumns("id", "time", "x_ft", "y_ft")
    text = "id,time,x_ft,y_ft,z,length\na,0,0,0,7,14\na,1,30,0,7,14\n"
    fixes = given("t.csv", text, columns=columns)
    assert fixes.types[0].lwh_m[:2] == pytest.approx((14 * 0.3048, 1.8))
    assert "z not read: the road is flat" in fixes.read_as
    assert any("lengths and widths in ft" in said for said in fixes.read_as)
    with pytest.raises(TrafficError, match=r"x_mm and y_m are named as m and mm\. Set --length-unit"):
        given("u.csv", "id,time,x_mm,y_m\na,0,0,0\n", columns=PositionColumns("id", "time", "x_mm", "y_m"))
    rows = "".join(f"{n},0,{n},0,k{n}\n" for n in range(7))
    fixes = given("c.csv", "id,time,x,y,class\n" + rows)
    assert fixes.read_as[0].endswith("k4 as passenger and 2 more")
    fixes = given("r.csv", "id,time,x,y,class\na,0,0,0,car\nb,0,9,0,train\n")
    assert fixes.read_as == ("train as cars here; a run leaves them out, because they are not on the road",)


def test_positions_in_pixels_or_miles_are_refused(given):
    for unit in ("px", "pixel", "miles"):
        x, y = f"x_{unit}", f"y_{unit}"
        text = f"id,time,{x},{y}\na,0,0,0\na,1,9,0\n"
        named = PositionColumns("id", "time", x, y)
        with pytest.raises(TrafficError, match=rf"named as {unit}, which is not read\. Turn them into metres"):
            given("t.csv", text, columns=named)
        assert given("t.csv", text, columns=named, length_unit_m=0.1).xy_m[1, 0] == pytest.approx(0.9)


def test_columns_of_sizes_may_say_their_unit_and_others_are_named(given):
    """Names of cosim's own tables; sizes in metres beside positions in feet; no height is read."""
    text = "id,time,x_ft,y_ft,length_m,width_cm,height_m\na,0,0,0,14,250,3.8\na,1,30,0,14,250,3.8\n"
    fixes = given("t.csv", text, columns=PositionColumns("id", "time", "x_ft", "y_ft"))
    assert fixes.types[0].lwh_m == pytest.approx((14, 2.5, 1.5))
    assert "height_m not read: such a size is that of the class" in fixes.read_as
    fixes = given("n.csv", "id,time,x,y,vehicle_length,width\na,0,0,0,14,2.5\n")
    assert fixes.read_as == ("vehicle_length, width not read: such a size is that of the class",)


def test_a_column_of_classes_is_read_or_named(given):
    """Argoverse 2 calls it object_type."""
    for name in ("object_type", "Class"):
        fixes = given("t.csv", f"id,time,x,y,{name}\na,0,0,0,bus\nb,0,9,0,pedestrian\n")
        assert fixes.kinds == ["bus", "pedestrian"] and fixes.read_as == ()
    fixes = given("o.csv", "id,time,x,y,road_user_category\na,0,0,0,bus\n")
    assert fixes.read_as == ("road_user_category not read: all are cars. A column of classes is named class",)


def test_degrees_beside_metres_are_said_to_be_left(given):
    fixes = given("t.csv", "id,time,x,y,lat,lon\na,0,0,0,60.1,24.9\n")
    assert fixes.read_as == ("lat, lon not read: x and y are the positions",)


def test_lengths_and_widths_that_are_exchanged_are_said(given):
    """A pedestrian may be wider than long."""
    text = "id,time,x,y,length,width\na,0,0,0,1.8,4.6\nb,0,9,0,4.6,1.8\nc,0,19,0,0.3,0.6\n"
    assert [said[:29] for said in given("t.csv", text).read_as] == ["1 actors are wider than long:"]


def test_hours_by_the_name_of_a_column(given):
    text = "id,time_h,x,y\na,0,0,0\na,0.0005,18,0\n"
    fixes = given("t.csv", text, columns=PositionColumns("id", "time_h", "x", "y"))
    assert fixes.time_s[1] == pytest.approx(1.8)


def test_nanoseconds_since_1970_are_read_from_integers(tmp_path):
    begin = 1_700_000_000_000_000_001
    rows = {"id": ["a", "a"], "time": [begin, begin + 500_000_000], "x": [0.0, 5.0], "y": [0.0, 0.0]}
    pq.write_table(pa.table(rows), tmp_path / "t.parquet")
    np.testing.assert_allclose(read([tmp_path / "t.parquet"]).time_s, [0, 0.5], atol=1e-6)


def test_exact_copies_are_no_error(given):
    fixes = given("t.csv", HEAD + "a,0,1,2\na,0,1,2\na,1,3,2\n")
    assert len(fixes.time_s) == 2 and fixes.repaired == {"repeated": 1}


def test_one_glitch_makes_no_metres_of_degrees(given):
    """A taxi in Rome at 10 m/s, whose receiver says 0, 0 once."""
    at = [f"a,{t},{12.48 + 1.2e-4 * t},41.9\n" for t in range(30)]
    at[9] = "a,9,0,0\n"
    with pytest.raises(TrafficError, match=r"hardly anything is faster than .* degrees with --lat and --lon"):
        given("t.csv", HEAD + "".join(at))
    assert given("t.csv", HEAD + "".join(at), length_unit_m=1.0).xy_m[1, 1] == 41.9


def test_vehicles_that_all_stand_are_in_metres(given):
    assert len(given("t.csv", HEAD + "a,0,1,2\na,1,1,2\nb,0,9,9\n").time_s) == 3
