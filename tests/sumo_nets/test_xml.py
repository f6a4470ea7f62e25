"""Hostile, damaged and foreign XML is refused with one clear line."""

import gzip

import pytest

from sumo_nets.footprints import read_footprints
from sumo_nets.network import check_for_cars
from sumo_nets.xml import stream
from tests.refusals import refused_in_one_line

LAUGHS = (
    '<?xml version="1.0"?><!DOCTYPE lolz [<!ENTITY lol "lol">'
    + "".join(f'<!ENTITY lol{i} "{f"&lol{i - 1};" * 10}">' for i in range(2, 9))
    + "]><additional><poly id='&lol8;'/></additional>"
)
THIEF = (
    '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/hostname">]>'
    '<additional><poly id="&x;" type="building" shape="0,0 1,0 1,1"/></additional>'
)
DTD = '<!DOCTYPE additional SYSTEM "http://example.invalid/x.dtd"><additional/>'


@pytest.mark.parametrize("text", [LAUGHS, THIEF, DTD], ids=["laughs", "thief", "dtd"])
@pytest.mark.parametrize("read", [read_footprints, check_for_cars])
def test_document_types_and_entities_are_refused(tmp_path, text, read):
    path = tmp_path / "hostile.xml"
    path.write_text(text)
    with refused_in_one_line(r"hostile\.xml, line 1: declares a document type"):
        read(path)


@pytest.mark.parametrize(
    ("text", "line"), [("<additional>\n<poly>\n</additional>", 3), ("", 1), ("\x00\x01\x02", 1), ("not xml at all", 1)]
)
def test_broken_xml_names_its_line(tmp_path, text, line):
    path = tmp_path / "broken.xml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"broken\.xml, line {line}: not well-formed XML"):
        read_footprints(path)


@pytest.mark.parametrize("keep", [0.5, 0.9])
def test_a_cut_off_gzip_file_is_called_damaged(tmp_path, keep):
    whole = gzip.compress(b"<additional>" + b"<poly/>" * 1000 + b"</additional>")
    path = tmp_path / "cut.xml.gz"
    path.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(ValueError, match=r"cut\.xml\.gz: damaged gzip file|not well-formed"):
        read_footprints(path)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere\.xml: cannot be read \(No such file or directory\)"):
        read_footprints(tmp_path / "nowhere.xml")


def test_one_huge_attribute_is_refused_at_once(tmp_path):
    """The parser reads an unfinished tag again with every chunk: 99 MB of one attribute would take minutes."""
    path = tmp_path / "x.xml"
    path.write_text(f'<a b="{"x" * 30_000_000}"/>')
    with pytest.raises(ValueError, match="a tag with its attributes is longer than 8,000,000 bytes"):
        stream(path, lambda name, attributes: None)
    path.write_text(f'<r><a b="{"x" * 2_000_000}"/>{"<b/>" * 2_500_000}</r>')  # a long file of short tags
    found = []
    stream(path, lambda name, attributes: found.append(len(attributes.get("b", ""))) if name == "a" else None)
    assert found == [2_000_000]
