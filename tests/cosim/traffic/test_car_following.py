"""Calibrated car-following: what changes in the files of a scenario, and what SUMO then drives with."""

import json

import pytest

from cosim.traffic.car_following import CALIBRATED, calibrated
from sumo_nets import sumocfg
from sumo_nets.catalogue import find
from sumo_nets.vtypes import read
from tests.cosim.traffic import mixed_scenario
from tests.drive import python

TYPES = """<additional>
    <!-- <vType id="old" decel="9"/> -->
    <vType id="car" sigma="0.5" note="a > b" decel='4.5'><param key="has.ssm.device" value="no"/></vType>
    <vType decel="4.0" vClass="truck" id="lorry" length="9"/>
    <vType id="walker" vClass="pedestrian" decel="4.5"/>
</additional>"""


def scenario(folder, types=TYPES):
    (folder / "net.net.xml").write_text("<net/>")
    (folder / "types.add.xml").write_text(types)
    (folder / "plain.rou.xml").write_text('<routes><vehicle id="a" depart="0"/></routes>')
    path = folder / "x.sumocfg"
    path.write_text(
        '<configuration><net-file value="net.net.xml"/><additional-files value="types.add.xml"/>'
        '<route-files value="plain.rou.xml"/></configuration>'
    )
    return sumocfg.read(path)


def test_only_types_change_and_only_what_is_calibrated(tmp_path):
    (tmp_path / "copies").mkdir()
    before = scenario(tmp_path)
    after = calibrated(before, tmp_path / "copies")
    assert after.routes == before.routes  # no types in it: SUMO reads the user's file itself
    defaults, types = after.additional
    assert types.read_text() == TYPES.replace(
        '<vType id="car" sigma="0.5" note="a > b" decel=\'4.5\'>',
        '<vType carFollowModel="EIDM" decel="1.5" jerkmax="5" accel="1.5" tau="1.0" minGap="2.0" id="car" '
        'note="a > b">',
    ).replace(
        '<vType decel="4.0" vClass="truck" id="lorry" length="9"/>',
        '<vType carFollowModel="EIDM" decel="1.5" jerkmax="5" tau="1.5" vClass="truck" id="lorry" length="9"/>',
    )
    assert defaults.read_text().count("DEFAULT_") == 2
    assert before.additional[0].read_text() == TYPES


def test_the_city_keeps_its_types_and_their_sizes(tmp_path):
    before = sumocfg.read(find("helsinki").sumocfg_path)
    after = calibrated(before, tmp_path)
    types = read(after.additional)
    assert {name: t for name, t in types.items() if not name.startswith("DEFAULT_")} == read(before.additional)
    assert set(CALIBRATED) >= {t.vclass for t in types.values()} - {"pedestrian"}


@pytest.mark.parametrize(
    ("types", "says"),
    [
        (TYPES.replace("<param", '<include href="plain.rou.xml"/><param'), "includes other files"),
        (TYPES.replace("<param", '<carFollowing-Krauss decel="3"/><param'), "<carFollowing-...>"),
    ],
)
def test_types_that_cannot_be_copied_are_refused_in_one_line(tmp_path, types, says):
    (tmp_path / "copies").mkdir()
    with pytest.raises(ValueError, match=says) as error:
        calibrated(scenario(tmp_path, types), tmp_path / "copies")
    assert "\n" not in str(error.value)
    assert "additional file" in str(error.value)


def test_types_in_an_included_file_are_refused(tmp_path):
    types = TYPES.replace("<additional>", '<additional><include href="more.add.xml"/>')
    (tmp_path / "more.add.xml").write_text('<additional><vType id="b"/></additional>')
    with pytest.raises(ValueError, match="is included by another file"):
        calibrated(scenario(tmp_path, types), tmp_path)


RUN = """
import json, sys
from pathlib import Path
import libsumo
from cosim.traffic.params import TrafficParams
from cosim.traffic.sumo import sumo_options
from cosim.traffic.sumo_process import Simulator
how, config, target = sys.argv[1:]
scratch = Path(target).parent
params = TrafficParams(step_s=0.5, car_following=how)
sumo = Simulator(sumo_options(params, Path(config), scratch, False), False, (0, 0))
hardest = 0.0
for _ in range(160):
    sumo.move()
    hardest = max([hardest, *(-libsumo.vehicle.getAcceleration(v) for v in libsumo.vehicle.getIDList())])
types = {t: (libsumo.vehicletype.getDecel(t), libsumo.vehicletype.getLength(t))
         for t in libsumo.vehicletype.getIDList() if not t.startswith("DEFAULT")}
Path(target).write_text(json.dumps([hardest, types]))
"""


def test_sumo_drives_with_the_calibrated_types(tmp_path):
    config = str(mixed_scenario.write(tmp_path / "mixed"))
    found = {}
    for how in ("scenario", "calibrated"):
        assert python(RUN, how, config, str(tmp_path / how)) == ""
        found[how] = json.loads((tmp_path / how).read_text())
    before, after = found["scenario"][1], found["calibrated"][1]
    assert before.keys() == after.keys()
    assert all(before[name][1] == after[name][1] for name in before)
    assert {name for name in before if before[name][0] != after[name][0] == 1.5} == {"kärra"}
    assert 0 < found["calibrated"][0] < found["scenario"][0]
