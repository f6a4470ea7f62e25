"""Options and files of a user's .sumocfg: what writes, opens ports or never ends is left out or refused."""

import gzip
import hashlib
import os
import re
import subprocess
from xml.etree import ElementTree

import pytest

from sumo_nets import sumocfg, sumotools
from sumo_nets.sumo_options import IGNORED, PASSED, READS, REFUSED, SYNONYMS
from tests.cosim.traffic import mixed_scenario
from tests.cosim.traffic.mixed_scenario import edited
from tests.cosim.traffic.worlds import live, same
from tests.refusals import refused_in_one_line


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    return mixed_scenario.write(tmp_path_factory.mktemp("mixed"))


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """Type and other names of every option of the installed SUMO, by name."""
    path = tmp_path_factory.mktemp("template") / "template.xml"
    sumotools.run("sumo", {"save-template": path}, path.parent)
    return {option.tag: option.attrib for section in ElementTree.parse(path).getroot() for option in section}


def test_every_option_of_sumo_is_in_exactly_one_list(template):
    lists = (set(READS), set(REFUSED), IGNORED, PASSED)
    known = set().union(*lists)
    assert known - {"osg-view"} == set(template) and sum(map(len, lists)) == len(known)  # of a sumo-gui with OSG
    reviewed = "18985df267251e4a"
    assert hashlib.sha256(" ".join(sorted(PASSED)).encode()).hexdigest()[:16] == reviewed, "read what SUMO has added"
    assert {name for name in PASSED if template[name]["type"] == "FILE"} == set()
    synonyms = {other: name for name, about in template.items() for other in about.get("synonymes", "").split()}
    del synonyms["?"]  # of help, and no name of an XML element
    assert synonyms == SYNONYMS


def test_whatever_a_configuration_asks_to_write_nothing_is_written(scenario, template, tmp_path):
    """Every ignored option at once, files as absolute paths; the same traffic as without them."""
    leak = tmp_path / "leak"
    leak.mkdir()
    values = {"FILE": "{}", "BOOL": "true", "INT": "1", "FLOAT": "1", "TIME": "1", "STR": "{}", "STR[]": "1"}
    ignored = sorted(IGNORED & set(template))
    texts = {name: values[template[name]["type"]].format(leak / name) for name in ignored} | {"remote-port": "8813"}
    options = "".join(f'<{name} value="{value}"/>' for name, value in texts.items())
    config = edited(scenario, tmp_path, change=lambda t: t.replace("</configuration>", options + "</configuration>"))
    before = {p: p.read_bytes() for p in config.parent.iterdir() if p.is_file()}
    worlds, report = live(str(config), 0, 20)
    assert list(leak.iterdir()) == [] and "sumo_errors" not in report
    assert {p: p.read_bytes() for p in config.parent.iterdir() if p.is_file()} == before
    same(worlds, live(str(scenario), 0, 20)[0])


def with_option(scenario, folder, option):
    """A copy of the scenario that has one more option among its inputs."""
    return edited(scenario, folder, change=lambda t: t.replace("</input>", option + "</input>"))


def refusal(config, says):
    """The one line by which a configuration is refused."""
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        sumocfg.read(config)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_options_that_end_sumo_are_refused(scenario, tmp_path, name):
    target = tmp_path / "target"
    option = f'<{name} value="{target}"/>'
    config = edited(scenario, tmp_path, change=lambda t: t.replace("<input>", option + "<input>"))
    assert str(config) in refusal(config, f"the option {name} is refused") and not target.exists()


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ('<verbosity value="1"/>', "SUMO 1.28 has no option verbosity. Did you mean verbose?"),
        ('<lua-script value="x.lua"/>', "SUMO 1.28 has no option lua-script"),
        ('<python-script value="x.py"/>', "SUMO 1.28 has no option python-script"),
        ('<C value="x.xml"/>', "the option save-configuration is refused"),
        ('<load-state value="gone.xml"/>', "load-state names"),
        ('<load-state value="/dev/zero"/>', "not a regular file"),
        ('<weight-files value="fifo"/>', "not a regular file"),
        ("<net-file><![CDATA[/dev/zero]]></net-file>", "not a regular file"),
        ('<net-file value="a.net.xml, b.net.xml"/>', "names several networks"),
    ],
)
def test_other_options_get_one_line(scenario, tmp_path, option, says):
    config = with_option(scenario, tmp_path, option)
    os.mkfifo(tmp_path / "fifo")
    refusal(config, says)


LOOP = '<additional><inductionLoop id="e" lane="ab_1" pos="50" period="10" file="{}"/></additional>'
HARMFUL = {
    "an address": ("odd.add.xml", LOOP.format("localhost:8813"), "an address to connect to"),
    "an address behind an entity": ("odd.add.xml", LOOP.format("localhost&#58;8813"), "an address to connect to"),
    "an address behind a bracket": ("odd.add.xml", LOOP.format("a>b:80"), "an address to connect to"),
    "an address in UTF-16": ("odd.add.xml", LOOP.format("localhost:8813").encode("utf-16"), "an address to connect to"),
    "an address of a device": (
        "odd.rou.xml", '<routes><vType id="t"><param key="device.ssm.file" value="host:80"/></vType></routes>',
        "an address to connect to",
    ),
    "an address in an included file": ("odd.add.xml", '<additional><include href="more.xml"/></additional>',
                                       "more.xml: <inductionLoop> has file = 'host:80'"),
    "a device to write": ("odd.add.xml", LOOP.format("/dev/zero"), "a device, pipe or folder"),
    "an included device": ("odd.add.xml", '<additional><include href="/dev/zero"/></additional>', "which is no file"),
    "no height": ("odd.rou.xml", '<routes><vType id="t" height="0"/></routes>', "vType 't': height = 0 m should be"),
    "a width of nothing": (
        "odd.rou.xml", '<routes><vType id="t" width="1e-300"/></routes>', "width = 1e-300 m should be",
    ),
    "a NaN height": ("odd.rou.xml", '<routes><vType id="t" height="nan"/></routes>', "height = nan m should be"),
    "an endless length": ("odd.rou.xml", '<routes><vType id="t" length="inf"/></routes>', "length = inf m should be"),
    "a length in words": ("odd.rou.xml", '<routes><vType id="t" length="x"/></routes>', "length = x m should be"),
    "a negative width": ("odd.rou.xml", '<routes><vType id="t" width="-1"/></routes>', "width = -1 m should be"),
    "an endless gap": ("odd.rou.xml", '<routes><vType id="t" minGap="inf"/></routes>', "minGap = inf is not a finite"),
}  # fmt: skip


@pytest.mark.parametrize("what", HARMFUL)
def test_harmful_files_are_refused(scenario, tmp_path, what):
    name, text, says = HARMFUL[what]
    config = edited(scenario, tmp_path)
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    (tmp_path / "more.xml").write_text(LOOP.format("host:80"))
    assert ".xml" in refusal(config, says)


EVIL = LOOP.format("127.0.0.1:9")


@pytest.mark.parametrize("name", ["evil.csv", "evil.csv.gz", "evil.parquet", "evil", "evil.net"])
@pytest.mark.parametrize("way", ["additional-files", "include", "rerouter", "device.fcd-replay.files", "load-state"])
def test_files_are_checked_by_their_content_whatever_their_name(scenario, tmp_path, name, way):
    """SUMO reads XML whatever the name of a file, and connects to the address in it."""
    text = EVIL.replace("<inductionLoop", "<!-- --><inductionLoop").encode()
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    more = {
        "include": f'<additional><include href="{name}"/></additional>',
        "rerouter": f'<additional><rerouter id="r" edges="ab" file="{name}"/></additional>',
    }
    listed = f'<{way} value="{name}"/>'
    if way in more:
        (tmp_path / "more.add.xml").write_text(more[way])
        listed = '<additional-files value="more.add.xml"/>'
    kept = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    config = with_option(scenario, tmp_path, listed)
    assert all((tmp_path / other).read_bytes() == content for other, content in kept.items())
    refusal(config, "which SUMO takes for an address to connect to")


def test_tables_of_travel_times_are_no_xml(scenario, tmp_path):
    (tmp_path / "all.csv").write_text("1;2;3\n")
    option = '<astar.all-distances value="all.csv"/>'
    config = with_option(scenario, tmp_path, option)
    assert tmp_path / "all.csv" in sumocfg.read(config).inputs


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (".\\odd.rou.xml", ""),
        ("gone\\odd.rou.xml", r"Windows separates folders by \\, this system by /"),
        ("C:\\me\\odd.rou.xml", "It is a path of Windows"),
        ("Odd.ROU.xml", "Did you mean .*odd.rou.xml"),
        ("od.rou.xml", "Did you mean .*odd.rou.xml"),
        ("elsewhere.xml", "Correct the path in the .sumocfg"),
    ],
)
def test_a_name_that_is_spelt_otherwise(scenario, tmp_path, given, says):
    config = edited(scenario, tmp_path, change=lambda t: t.replace("odd.rou.xml", given))
    if not says:
        assert sumocfg.read(config).routes[0].is_file()
        return
    with pytest.raises(ValueError, match=says) as caught:
        sumocfg.read(config)
    assert "which does not exist" in str(caught.value)


def test_a_long_tag_hides_no_address(scenario, tmp_path):
    config = edited(scenario, tmp_path)
    (tmp_path / "odd.add.xml").write_text(LOOP.format("x" * 200_000 + ":80"))
    refusal(config, "an address to connect to")


def test_a_decompression_bomb_is_not_read_to_its_end(scenario, tmp_path):
    """400 MB of blanks in 400 kB; SUMO's own files expand 30 times at most."""
    config = edited(scenario, tmp_path, change=lambda t: t.replace("odd.rou.xml", "bomb.rou.xml.gz"))
    head, blanks, foot = (gzip.compress(text) for text in (b"<routes>", b" " * (1 << 20), b"</routes>"))
    (tmp_path / "bomb.rou.xml.gz").write_bytes(head + 400 * blanks + foot)
    refusal(config, "bomb.rou.xml.gz: expands to more than 200 times its size")


def test_a_typing_error_in_a_network_names_the_file_and_the_line(scenario, tmp_path):
    from cosim.traffic.scenario import find

    for change in (
        lambda t: t.replace('shape="', 'shape="x', 3),
        lambda t: t.replace("convBoundary=", "convBundary="),
        lambda t: t.replace('convBoundary="', 'convBoundary="nan,'),
    ):
        config = edited(scenario, tmp_path, "odd net.net.xml", change)
        with refused_in_one_line(r"odd net\.net\.xml"):
            find(str(config)).city()


def test_the_copy_that_sumo_reads_has_absolute_paths_and_no_more(scenario):
    config = sumocfg.read(scenario)
    text = config.text()
    assert "tripinfo" not in text and "save-state" not in text and "log" not in text
    names = {option.tag: option.get("value") for option in ElementTree.fromstring(text)}
    assert set(names) == {"net-file", "route-files", "additional-files", "begin", "end", "time-to-teleport"}
    assert names["net-file"].endswith("odd%20net.net.xml") and names["net-file"].startswith("/")
    assert {path.name for path in config.inputs} == {
        "odd.sumocfg", "odd net.net.xml", "odd.rou.xml", "odd.add.xml", "odd.poly.xml",
    }  # fmt: skip


def test_the_first_departure(tmp_path):
    (tmp_path / "a.rou.xml").write_text('<routes><vType id="t"/><vehicle id="v" depart="6:00:01"/></routes>')
    (tmp_path / "b.rou.xml").write_text('<routes><flow id="v" begin="30000"/></routes>')
    assert sumocfg.first_departure_s([tmp_path / "b.rou.xml", tmp_path / "a.rou.xml"]) == 21_601


def test_sumo_itself_was_asked(template):
    """The lists are for this version; another one may have options that nobody has looked at."""
    done = subprocess.run([str(sumotools.home() / "bin" / "sumo"), "--version"], capture_output=True, text=True)
    assert "1.28" in done.stdout and len(template) > 400


def test_files_that_are_known_are_checked_again_once_they_change(scenario, tmp_path):
    config = edited(scenario, tmp_path)
    routes = sumocfg.read(config).routes[0]
    good = routes.read_text()
    routes.write_text(good.replace("<routes", '<routes><include href="none.xml"/></routes><routes', 1))
    with pytest.raises(ValueError, match=r"includes .*none\.xml, which is no file"):
        sumocfg.read(config)
    routes.write_text(good)
    assert sumocfg.read(config).routes[0] == routes
