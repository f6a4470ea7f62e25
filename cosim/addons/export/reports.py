"""Misbehaviour reports in the structure of ETSI TS 103 759, as JSON: what evaluators hold against senders.

Notes
-----
`reports/step-<step>.json`, a list of reports; `results/misbehaviour_report.schema.json` is their schema. Member names,
their order and their meaning are those of the ASN.1 modules of TS 103 759 V2.2.1, as second sources quote them:
`EtsiTs103759Data` with a plaintext report; generation time, observation location, and a report for an ITS-AID (639,
CPM) with observations by target, V2X PDUs as evidence, and other evidence. Deviations: the encoding is JSON, not ASN.1,
and nothing is signed. A report is about one message, which may be of an earlier step (`sensing_phase = "random"`). What
`LEFT_OUT` names is left out, and the export says how much of it there was. The standard has no observations about
perceived objects, so target and observations are private ones: target 200 "perceived object" with the observations 1
"not detected where visible" and 2 "contradicted by free space". The standard has no scores: evaluation and visibility
stand in `nonV2xPduEvidence`. Evidence is the sender's CPM as an unsecured GeoNetworking packet (PDU type 1), as `cosim
export pcap` writes it. `objectIndex` counts the objects of a message from 1, over all its segments, and 0 is the self
report; it is neither `detection_index`, which also counts what is not sent, nor the CPM's `objectId`. The reporter is
told by the signature in the standard; here `reporter` names its pseudonym, beside the report.
"""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from annotated_types import Ge, Le
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.export import kitti, pcap
from cosim.messages import etsi
from results.moments import Clouds, File, Plan, Selection, at_steps, units_of_steps

TABLES = ("actors", "vehicles", "pseudonyms", "detections", "evaluations")
VERSION, CPM_AID, GN_PDU = 3, 639, 1
TARGET, NOT_DETECTED, FREE_SPACE = 200, 1, 2
"""Private target and observations; the targets that second sources quote from the standard are below 10."""
ETHERNET_BYTES = 14
LOWEST_DM = 4095
"""`Elevation` of IEEE 1609.2 counts decimetres above -409.5 m."""
REPORT_BYTES = 2500
"""Of one report, roughly."""

LEFT_OUT = (
    "of an object that a message lacks or of a velocity, for which there is no observation here",
    "by roadside units, which the table actors does not place",
    "by vehicles that were not chosen",
    "about messages of roadside units",
    "about messages that the table detections does not hold",
)
"""Why a denial is in no report; of several reasons the first one counts."""

_KEYS = ["step", "evaluator", "observer", "detection_step", "detection_index"]


@dataclass(frozen=True, kw_only=True)
class Params(pcap.PcapPlace):
    """Which evaluations are reported."""

    threshold: Annotated[float, Ge(-1), Le(1)] = -0.5
    """A detection is reported if the evaluation times the visibility is below this."""


class MisbehaviourReports:
    """Reports of ETSI TS 103 759 as JSON."""

    Params = Params
    TABLES = TABLES

    def __init__(self, params: Params | None = None) -> None:
        self._params = params or Params()

    def plan(self, selection: Selection) -> Plan:
        """One file per step with reports, in blocks; then the names.

        Raises
        ------
        ValueError
            In one line: it is not known where on Earth the run is.
        """
        projection = pcap.projection_of(self._params, selection)
        made = _Reports(selection, pcap.PcapPackets(selection, projection), self._params.threshold)
        units = units_of_steps(selection.spans(), made.files)
        units.append(kitti.names(selection))
        return Plan(tuple(units), 0, 0, REPORT_BYTES * len(selection.presence), made.remarks())


@dataclass(frozen=True)
class _Reports:
    selection: Selection
    packets: pcap.PcapPackets
    threshold: float

    def _denials(
        self,
        steps: Int[ndarray, "b"],
    ) -> tuple[pd.DataFrame, Int[ndarray, "k"]]:
        """Denials made in some steps, with the column vehicle of the evaluator; and why each is left out.

        Returns
        -------
        The rows, and the place of the reason in `LEFT_OUT`, or its length where a report has the denial.
        """
        run = self.selection.run
        columns = [*_KEYS, "kind", "evaluation", "visibility", "n_points", "plausible"]
        found = run.table("evaluations", columns, at_steps(steps))
        low = found[found.evaluation * found.visibility < self.threshold].sort_values(_KEYS)
        subjects = run.subjects
        low = low.assign(vehicle=low.evaluator.map(subjects.vehicle))
        messages = run.table("detections", ["step", "observer", "transmitted"], at_steps(np.unique(low.detection_step)))
        sent = messages[messages.transmitted].drop_duplicates()
        message = pd.MultiIndex.from_frame(low[["detection_step", "observer"]])
        reasons: list[Any] = [
            low.kind != "detection",
            low.vehicle.isna(),
            ~low.vehicle.isin(list(self.selection.vehicles)),
            ~low.observer.isin(subjects.index),
            ~message.isin(pd.MultiIndex.from_frame(sent[["step", "observer"]])),
        ]
        return low, np.argmax([*reasons, np.ones(len(low), bool)], axis=0)

    def remarks(self) -> tuple[str, ...]:
        """How many denials are in no report, and why; nothing if all are."""
        counts: Counter[int] = Counter()
        for steps in self.selection.spans():
            counts.update(self._denials(steps)[1].tolist())
        n_left_out = counts.total() - counts[len(LEFT_OUT)]
        if not n_left_out:
            return ()
        why = []
        for k, reason in enumerate(LEFT_OUT):
            if counts[k]:
                why.append(f"{counts[k]:,} {reason}")
        return (f"{n_left_out:,} of {counts.total():,} denials are in no report: {'; '.join(why)}.",)

    def files(self, steps: Int[ndarray, "b"], clouds: Clouds) -> Iterator[File]:
        """The reports of each step, by reporter, reported pseudonym and message."""
        run = self.selection.run
        low, reason = self._denials(steps)
        low = self._numbered(low[reason == len(LEFT_OUT)].astype({"vehicle": np.int64}))
        senders = sorted(set(low.observer.tolist()))
        frames = self.packets.frames(np.unique(low.detection_step), senders)
        poses = run.table("actors", ["step", "actor", "x_m", "y_m", "z_m"], at_steps(steps))
        places = poses.set_index(["step", "actor"])[["x_m", "y_m", "z_m"]]
        for step in np.unique(low.step).tolist():
            reports, of_step = [], low[low.step == step]
            for _, rows in of_step.groupby(["evaluator", "observer", "detection_step"]):
                names = ["evaluator", "observer", "vehicle", "detection_step"]
                reporter, subject, vehicle, sent_step = rows[names].iloc[0].astype(int).tolist()
                at_m = places.loc[(step, vehicle)].to_numpy(float)
                report = self._report(step, rows, at_m, frames[sent_step, subject])
                reports.append({"reporter": reporter, "subject": subject, "data": report})
            yield File(f"reports/step-{step:06d}.json", partial(_content, reports))

    def _numbered(self, denials: pd.DataFrame) -> pd.DataFrame:
        """Denials with the column object_index: place of the object in its message, from 1; 0 is the self report."""
        where = at_steps(np.unique(denials.detection_step)) & (pc.field("detection_index") > 0)
        key = ["step", "observer", "detection_index"]
        objects = self.selection.run.table("detections", [*key, "transmitted"], where)
        objects = objects[objects.transmitted].sort_values(key)
        objects["object_index"] = objects.groupby(key[:2]).cumcount() + 1
        objects = objects.drop(columns="transmitted").rename(columns={"step": "detection_step"})
        found = denials.merge(objects, how="left", on=["detection_step", *key[1:]])
        return found.assign(object_index=found.object_index.fillna(0).astype(np.int64))

    def _report(
        self,
        step: int,
        rows: pd.DataFrame,
        at_m: Float[ndarray, "3"],
        packets: list[bytes],
    ) -> dict[str, Any]:
        """One report, of one reporter about one sender, from its evaluations of detections of this sender."""
        place = self.packets.projection.of_world(at_m[None, :2])
        step_ms = round(1000 * step * self.selection.run.dt_s)
        time_us = 1000 * (etsi.its_ms(pcap.START_S) + step_ms)
        denied = rows.plausible.eq(False).fillna(False).to_numpy(bool)
        numbers = rows.object_index.tolist()
        observed = [
            {"obsId": FREE_SPACE if free else NOT_DETECTED, "obs": {"objectIndex": number}}
            for number, free in zip(numbers, denied.tolist(), strict=True)
        ]
        evidence = []
        said: Any
        for said in rows.itertuples():
            evidence.append(
                {
                    "objectIndex": said.object_index,
                    "evaluation": round(said.evaluation, 4),
                    "visibility": round(said.visibility, 4),
                    "nPoints": said.n_points,
                }
            )
        pdus = [packet[ETHERNET_BYTES:].hex() for packet in packets]
        report = {
            "generationTime": time_us,
            "observationLocation": {
                "latitude": round(1e7 * float(place.latitude_deg[0])),
                "longitude": round(1e7 * float(place.longitude_deg[0])),
                "elevation": LOWEST_DM + round(10 * float(at_m[2])),
            },
            "report": {
                "aid": CPM_AID,
                "content": {
                    "observations": [{"tgtId": TARGET, "observations": observed}],
                    "v2xPduEvidence": [{"type": GN_PDU, "v2xPdus": pdus, "subjectPduIndex": len(pdus) - 1}],
                    "nonV2xPduEvidence": evidence,
                },
            },
        }
        return {"version": VERSION, "content": {"plaintext": report}}


def _content(reports: list[dict[str, Any]]) -> bytes:
    return json.dumps(reports, indent=1).encode()
