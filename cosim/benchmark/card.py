"""The Croissant card of the evidence set (Croissant 1.0 of MLCommons)."""

import json
from pathlib import Path
from typing import Any

from cosim import __version__
from cosim.benchmark.evidence import MANIFEST, TABLES, EvidenceSet
from results import durable
from results.cards import CONTEXT, CROISSANT, PARQUET, TYPES

LICENCE = "https://spdx.org/licenses/Apache-2.0"
_INTEGER = TYPES["int16"]


def citation(evidence: EvidenceSet) -> str:
    """How to cite the set."""
    return (
        f"cosim trust benchmark, evidence set {evidence.version}, sha256 {evidence.checksum[:16]}, "
        f"made with cosim {__version__}"
    )


def write(evidence: EvidenceSet, folder: Path) -> Path:
    """Write the card of a set into its folder."""
    rules = evidence.rules
    card: dict[str, Any] = {
        "@context": CONTEXT, "@type": "sc:Dataset", "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": "cosim trust benchmark",
        "description": f"Evaluations as trust models receive them, in {len(evidence.worlds)} simulated worlds of "
        f"{rules.n_steps * rules.dt_s:g} s, without attack and under each of {len(rules.cases) - 1} attacks.",
        "version": f"{evidence.version}.0.0", "license": LICENCE, "citeAs": citation(evidence),
        "url": f"urn:sha256:{evidence.checksum}",
        "keywords": ["V2X", "cooperative perception", "trust", "misbehaviour detection"],
        "distribution": [
            {"@type": "cr:FileObject", "@id": path, "name": path, "contentUrl": path, "encodingFormat": kind,
             "sha256": durable.sha256(folder / path)}
            for path, kind in [(MANIFEST, "application/json"), *((f"{name}.parquet", PARQUET) for name in TABLES)]
        ],
        "recordSet": [_record_set(name) for name in TABLES],
    }  # fmt: skip
    path = folder / CROISSANT
    durable.write_output(path, (json.dumps(card, indent=1, ensure_ascii=False) + "\n").encode())
    return path


def _record_set(name: str) -> dict[str, Any]:
    columns = {
        "world": "Number of the world, from 0; `benchmark.json` lists them.",
        "case": "Number of the attack; 0 is without attack.",
        "gone": "1 if the row of case 0 with this key is absent in this case.",
    } | {c: of.meaning + (f" [{of.unit}]" if of.unit else "") for c, of in TABLES[name].columns.items()}
    return {
        "@type": "cr:RecordSet", "@id": name, "name": name, "description": TABLES[name].meaning,
        "key": [{"@id": f"{name}/{column}"} for column in ("world", "case", *TABLES[name].keys)],
        "field": [
            {"@type": "cr:Field", "@id": f"{name}/{column}", "name": f"{name}/{column}", "description": meaning,
             "dataType": _INTEGER,
             "source": {"fileObject": {"@id": f"{name}.parquet"}, "extract": {"column": column}}}
            for column, meaning in columns.items()
        ],
    }  # fmt: skip
