"""Misbehaviour reports: one by hand, and all of a made-up run against the published schema."""

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from cosim.addons.export import pcap, reports
from cosim.base.earth import Projection
from tests.addons.export import readers, truck

SCHEMA = json.loads((Path(__file__).parents[3] / "results" / "misbehaviour_report.schema.json").read_text())
NORTH = Projection(60.0, 25.0)


def evaluation(step, evaluator, value=-1.0, visibility=1.0, plausible=True, **more):
    return {
        "step": step, "evaluator": evaluator, "observer": 0, "detection_index": 1, "evaluation": value, "n_points": 40,
        "visibility": visibility, "plausible": plausible, "matched": False, "lied": False,
    } | more  # fmt: skip


ROWS = [
    evaluation(1, 1, visibility=0.4),  # -0.4 is above the threshold
    evaluation(1, 3, 0.9, plausible=None, matched=True),
    evaluation(2, 1, visibility=0.75),
    evaluation(2, 3, plausible=False),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return truck.make(tmp_path_factory.mktemp("export") / "run", evaluations=ROWS)


def written(run, folder, **params):
    of = replace(truck.selection(run), projection=lambda: NORTH)
    made = truck.written(reports.MisbehaviourReports(reports.Params(**params)).plan(of), folder)
    return {path: json.loads(content) for path, content in made.items() if path.endswith(".json")}


def test_by_hand(run, tmp_path):
    """In step 2 the truck and the car behind deny the first car's detection 1, which they should see."""
    (path, found), = written(run, tmp_path).items()  # fmt: skip
    assert path == "reports/step-000002.json"
    assert [(report["reporter"], report["subject"]) for report in found] == [(1, 0), (3, 0)]
    first, second = (report["data"]["content"]["plaintext"] for report in found)
    dt_s = run.dt_s
    assert first["generationTime"] == 1000 * (662_774_405_000 + round(2000 * dt_s))  # as in test_pcap
    # the truck's middle is at (97, 70), 1.75 m high
    place = first["observationLocation"]
    assert place["latitude"] == pytest.approx((60 + 70 / 111412) * 1e7, abs=3)
    assert place["longitude"] == pytest.approx((25 + 97 / 55800) * 1e7, abs=3) and place["elevation"] == 4095 + 18
    content = first["report"]["content"]
    assert first["report"]["aid"] == 639
    assert content["observations"] == [{"tgtId": 200, "observations": [{"obsId": 1, "obs": {"objectIndex": 1}}]}]
    assert content["nonV2xPduEvidence"] == [{"objectIndex": 1, "evaluation": -1.0, "visibility": 0.75, "nPoints": 40}]
    assert second["report"]["content"]["observations"][0]["observations"][0]["obsId"] == 2
    jsonschema.validate(found, SCHEMA)


def test_the_evidence_is_the_message_that_was_sent(run, tmp_path):
    (found,) = written(run, tmp_path).values()
    (stream,) = found[0]["data"]["content"]["plaintext"]["report"]["content"]["v2xPduEvidence"]
    head = b"\xff" * 6 + pcap.mac(0) + b"\x89\x47"
    records = [pcap.record(pcap.START_S, head + bytes.fromhex(pdu)) for pdu in stream["v2xPdus"]]
    capture = pcap.pcap_header() + b"".join(records)
    (tmp_path / "evidence.pcap").write_bytes(capture)
    frames = readers.pcap(tmp_path / "evidence.pcap")
    (seen,) = readers.cpm(frames[stream["subjectPduIndex"]]["message"])["objects"]
    assert seen["class"] == "truck" and seen["number"] == 1


def test_objects_are_counted_in_the_message(tmp_path):
    """Detection 1 is not sent in step 3, so that detection 2 is the first object of the message."""
    boxes = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5, "class": "car", "score": 0.9, "origin": "sensed"}
    more = {"step": 3, "observer": 0, "detection_index": 2, "transmitted": True, **boxes}
    rows = [evaluation(3, 1, detection_index=k, detection_step=3) for k in (0, 2)]
    run = truck.make(tmp_path / "run", evaluations=rows, detected=[more])
    (found,) = written(run, tmp_path / "out").values()
    evidence = found[0]["data"]["content"]["plaintext"]["report"]["content"]["nonV2xPduEvidence"]
    assert [one["objectIndex"] for one in evidence] == [0, 1]


def test_threshold(run, tmp_path):
    assert not written(run, tmp_path / "none", threshold=-1.0)
    assert sorted(written(run, tmp_path / "more", threshold=-0.3)) == [
        "reports/step-000001.json", "reports/step-000002.json"
    ]  # fmt: skip


def test_reports_and_what_is_left_out_are_all_denials(tmp_path):
    """Of seven denials, three are reported: of this step's message, and of two earlier ones."""
    rows = [
        evaluation(2, 1),
        evaluation(2, 1, detection_index=0, detection_step=1),
        evaluation(3, 3, detection_step=0),
        evaluation(3, 4, detection_step=0),  # 4 is a roadside unit
        evaluation(3, 1, observer=4),
        evaluation(3, 1, observer=3, detection_step=0),  # 3 comes in step 1
        evaluation(3, 1, kind="speed"),
        evaluation(3, 1, -0.2, detection_step=2),  # is no denial
    ]
    rows = [{"kind": "detection", "detection_step": row["step"]} | row for row in rows]
    run = truck.make(tmp_path / "run", units=[4], evaluations=rows)
    table = run.table("evaluations")
    n_denials = int((table.evaluation * table.visibility < -0.5).sum())
    of = replace(truck.selection(run), projection=lambda: NORTH)
    plan = reports.MisbehaviourReports().plan(of)
    made = truck.written(plan, tmp_path / "out")
    found = [report for path, content in made.items() if path.endswith(".json") for report in json.loads(content)]
    jsonschema.validate(found, SCHEMA)
    evidence = [report["data"]["content"]["plaintext"]["report"]["content"]["nonV2xPduEvidence"] for report in found]
    assert sum(map(len, evidence)) == 3 and n_denials == 7
    assert plan.remarks == (
        "4 of 7 denials are in no report: 1 of an object that a message lacks or of a velocity, for which there is no "
        "observation here; 1 by roadside units, which the table actors does not place; 1 about messages of roadside "
        "units; 1 about messages that the table detections does not hold.",
    )
    fewer = reports.MisbehaviourReports().plan(replace(of, vehicles=(0, 3)))
    assert "4 by vehicles that were not chosen" in fewer.remarks[0]


def test_the_evidence_is_the_message_of_the_earlier_step(tmp_path):
    """In step 3 the car behind denies what the first car said in step 1: the packet is that of step 1."""
    run = truck.make(tmp_path / "run", evaluations=[evaluation(3, 3, detection_step=1)])
    ((report,),) = written(run, tmp_path).values()
    (stream,) = report["data"]["content"]["plaintext"]["report"]["content"]["v2xPduEvidence"]
    packets = pcap.PcapPackets(replace(truck.selection(run), projection=lambda: NORTH), NORTH)
    sent = packets.frames(np.array([1]), [0])[1, 0]
    assert stream["v2xPdus"] == [packet[reports.ETHERNET_BYTES :].hex() for packet in sent]


def test_the_schema_refuses_a_report_without_evidence(run, tmp_path):
    (found,) = written(run, tmp_path).values()
    found[0]["data"]["content"]["plaintext"]["report"]["content"]["v2xPduEvidence"] = []
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(found, SCHEMA)
