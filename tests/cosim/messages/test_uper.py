"""UPER: encodings by hand, messages that a generated codec confirmed, lengths, and values out of range.

`uper_vectors.json` holds random CPMs and CAMs of our own making. A codec that asn1c generated from the ASN.1 modules
decoded each of them to the same values, found no constraint violated, and encoded them to the same bytes. The CAMs
passed with the modules of release 1 and of release 2.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from cosim.base.codes import ObjectClass
from cosim.messages import cam, cpm, etsi, uper
from tests.refusals import refused_in_one_line

VECTORS = json.loads((Path(__file__).parent / "uper_vectors.json").read_text())
TYPES = {"cpm": cpm.CPM, "cam": cam.CAM}
BASE = ("objectId", "angles", "objectDimensionZ", "objectDimensionY", "objectDimensionX", "objectPerceptionQuality",
        "classification")  # fmt: skip


def objects(rng, n):
    """Columns of random objects."""
    return (
        rng.integers(0, 2**15, n), rng.integers(0, 4, n), rng.uniform(-1500, 1500, (n, 3)),
        rng.uniform(0.1, 30, (n, 3)), rng.uniform(-7, 7, n), rng.uniform(0, 1, n),
    )  # fmt: skip


def head(**more):
    known = {"station": 7, "time_ms": 10**12, "latitude": 1, "longitude": -1, "heading": 9, "range_m": 80.0}
    return cpm.CpmHead(**known | more)


@pytest.mark.parametrize("row", range(len(VECTORS)))
def test_messages_that_a_generated_codec_confirmed(row):
    one = VECTORS[row]
    assert uper.encode(TYPES[one["message"]], one["value"]).hex() == one["hex"]


def test_vectors_have_everything_that_is_written():
    text = json.dumps(VECTORS)
    names = {name for kind in TYPES.values() for r in uper.table(kind) for name in re.findall(r"\w+", r.field)}
    assert not {name for name in names if not name.isdigit() and f'"{name}"' not in text}
    lengths = {len(v["hex"]) // 2 for v in VECTORS}
    assert min(lengths) < 40 and max(lengths) > 128 + 40, "one and two bytes of length"


def test_a_record_by_hand():
    """Extension bit 0, bitmap 01, 5 - 2 = 3 in three bits, the third of three numbers in two bits: 0 01 011 10."""
    number, sort = uper.Integer("Number", "M", 2, 9), uper.Enumerated("Sort", "M", (0, 1, 15))
    of = uper.Record("Both", "M", (
        uper.Member("a", number), uper.Member("b", number, True), uper.Member("c", sort, True),
    ), True)  # fmt: skip
    assert uper.encode(of, {"a": 5, "c": 15}) == bytes([0b00101110])
    assert uper.n_bits(of, {"a": 5, "b": 2, "c": 0}) == 11


def test_list_and_choice_by_hand():
    """Extension bit, two of one to four elements (01), each with the extension bit, the index, and the number."""
    of = uper.ListOf(
        "List", "M", uper.UperChoice("Which", "M", {"x": uper.Integer("N", "M", 0, 3), "y": None}, True), 1, 4, True
    )
    assert uper.encode(of, [("x", 3), ("x", 1)]) == bytes([0b00100110, 0b00100000])


def test_open_types_have_their_length_in_one_or_two_bytes():
    byte, nothing = uper.Integer("Byte", "M", 0, 255), uper.Integer("Z", "M", 0, 0)
    of = uper.Wrapped("W", "M", byte, {1: uper.ListOf("L", "M", byte, 0, 65535), 2: nothing})
    assert uper.encode(of, (1, [7] * 125))[:2] == bytes([1, 127])
    assert uper.encode(of, (1, [7] * 126))[:3] == bytes([1, 0x80, 128])
    assert uper.encode(of, (1, [7] * 16381))[:3] == bytes([1, 0xBF, 0xFF])
    assert uper.encode(of, (2, 0)) == bytes([2, 1, 0]), "at least one byte"
    with pytest.raises(ValueError, match="16384 bytes do not fit"):
        uper.encode(of, (1, [7] * 16382))


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ({"objectId": 65536}, "Identifier2B is 65536, but ETSI-ITS-CDD allows 0 to 65535"),
        ({"acceleration": 0}, "PerceivedObject has no member acceleration here"),
        ({"velocity": ("polarVelocity", {})}, "Velocity3dWithConfidence has no alternative polarVelocity here"),
        ({"sensorIdList": []}, "SequenceOfIdentifier1B is 0, but ETSI-ITS-CDD allows 1 to 128"),
        ({"classification": [{"objectClass": ("vruSubClass", ("pedestrian", 4)), "confidence": 1}]}, "is 4, but"),
        ({"objectAge": np.array([5, 2048])}, "DeltaTimeMilliSecondSigned is 2048, but"),
    ],
)
def test_what_does_not_fit_is_one_line(value, says):
    with refused_in_one_line(says):
        uper.encode(cpm.OBJECT, uper.least(cpm.OBJECT) | value)


@pytest.mark.parametrize("seed", range(3))
def test_objects_together_equal_objects_one_by_one(seed):
    """Rows of bits, as numbers read by hand from the columns, encode as single values do."""
    rng = np.random.default_rng(seed)
    number, label, xyz, lwh, angle, score = columns = objects(rng, 40)
    many = cpm.CpmObjects.of(*columns)

    def tenths(value, unit):
        return int(np.ceil(value / unit - 1e-3))

    values = []
    for i in range(40):
        place = [max(-131072, min(131071, tenths(v, 0.01))) for v in xyz[i]]
        size = [min(255, tenths(v, 0.1)) for v in lwh[i]]
        values.append({
            "objectId": int(number[i]), "measurementDeltaTime": 0,
            "position": {f"{a}Coordinate": {"value": v, "confidence": 4096} for a, v in zip("xyz", place, strict=True)},
            "angles": {"zAngle": {"value": tenths(np.degrees(angle[i]) % 360, 0.1) % 3600, "confidence": 127}},
            "objectDimensionZ": {"value": size[2], "confidence": 32},
            "objectDimensionY": {"value": size[1], "confidence": 32},
            "objectDimensionX": {"value": size[0], "confidence": 32},
            "sensorIdList": [1],
            "classification": [{"objectClass": cpm.CLASSES[label[i]], "confidence": max(1, round(100 * score[i]))}],
        })  # fmt: skip
    of = uper.ListOf("PerceivedObjects", "M", cpm.OBJECT, 0, 255, True)
    assert uper.encode(of, many.between(3, 30)) == uper.encode(of, values[3:30])


@pytest.mark.parametrize("segment", [None, (3, 2)])
def test_length_is_that_of_the_bytes(segment):
    rng, lengths, counts = np.random.default_rng(5), [], []
    for n in (0, 1, 2, 3, 4, 17, 100, 255):
        columns = objects(rng, n)
        lengths.append(len(cpm.cpm(head(segment=segment), n, cpm.CpmObjects.of(*columns).between(0, n))))
        counts.append(np.bincount(columns[1], minlength=4))
    assert cpm.cpm_bytes(np.array(counts), is_segment=segment is not None).tolist() == lengths
    with pytest.raises(ValueError, match="0 to 255 objects"):
        cpm.cpm_bytes(np.array([[200, 56, 0, 0]]))
    with pytest.raises(ValueError, match="speed is no optional member"):
        cpm.object_bits(["speed"])


@pytest.mark.parametrize(
    ("members", "published"),
    [
        (BASE, 23.6),
        ((*BASE, "velocity"), 29.4),
        ((*BASE, "velocity", "objectAge", "sensorIdList"), 32.8),
        ((*BASE, "velocity", "objectAge", "sensorIdList", "zCoordinate"), 36.5),
    ],
)
def test_published_lengths_of_an_object(members, published):
    """They count the class of a vehicle as 8 bits; `vehicleSubClass` is 0 to 14, which is 4 bits."""
    bits = cpm.object_bits(members)
    assert round((bits[ObjectClass.CAR] + 4) / 8 + 1e-9, 1) == published
    assert (bits - bits[ObjectClass.CAR]).tolist() == [0, 2, 3, 0]


def test_cams_are_forty_one_bytes():
    n, rng = 50, np.random.default_rng(1)
    speed = np.where(rng.random(n) < 0.2, np.nan, rng.uniform(-5, 200, n))
    senders = etsi.PositionVectors(
        station=rng.integers(0, 2**32, n),
        label=rng.integers(0, 4, n),
        time_ms=rng.integers(0, 2**42, n),
        latitude=np.full(n, 601700000),
        longitude=np.full(n, 249400000),
        heading=rng.integers(0, 3600, n),
        speed_mps=speed,
    )
    rows = cam.cams(senders, rng.uniform(-30, 30, n), rng.uniform(0.1, 200, (n, 3)))
    assert rows.shape == (n, 41) and uper.n_bits(cam.CAM, uper.least(cam.CAM)) == 322
    assert rows[0].tobytes()[:2] == bytes([2, 2])


def test_rounding_and_time():
    """TS 102 894-2 rounds up, and gives 94,694,401,000 ms at 2007-01-01; four more leap seconds came until 2017."""
    values = np.array([0.0, 0.01, 0.011, -0.009, 99.0, np.nan])
    assert etsi.up(values, 0.01, -5, 50, 77).tolist() == [0, 1, 2, 0, 50, 77]
    assert etsi.its_ms(1_167_609_600) == 94_694_401_000 + 4_000
    assert etsi.heading(np.array([-0.04, 359.96, 90.0])).tolist() == [0, 0, 900]
