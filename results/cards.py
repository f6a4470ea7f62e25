"""Descriptions of a run or a study for search engines and archives: a Croissant card and an RO-Crate.

Notes
-----
`croissant.json` follows Croissant 1.0 of MLCommons: a file set for each table, and a record set with every column that
is on disk, its type, unit and meaning. `ro-crate-metadata.json` follows RO-Crate 1.1 with the profile Process Run
Crate: the files with checksums, the program with its version, and the run as an action with the config as its input.
Both are made from manifest, inventory and dictionary alone. Paths are relative to the folder, which is the crate. The
date is that of the manifest (of `study.toml`).
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from results import durable
from results.columns import Column
from results.manifest import CONFIG, MANIFEST
from results.run import Run
from results.study import Study
from results.tables import SCHEMA_VERSION, TABLES

CROISSANT, RO_CRATE = "croissant.json", "ro-crate-metadata.json"
PARQUET = "application/x-parquet"
PROGRAM = "#cosim"
NO_LICENCE = "No licence is stated: ask the authors."

Entity = dict[str, Any]

CONTEXT: Entity = {
    "@language": "en", "@vocab": "https://schema.org/", "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/", "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/", "citeAs": "cr:citeAs", "column": "cr:column", "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"}, "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"}, "extract": "cr:extract", "field": "cr:field",
    "fileProperty": "cr:fileProperty", "fileObject": "cr:fileObject", "fileSet": "cr:fileSet", "format": "cr:format",
    "includes": "cr:includes", "isLiveDataset": "cr:isLiveDataset", "jsonPath": "cr:jsonPath", "key": "cr:key",
    "md5": "cr:md5", "parentField": "cr:parentField", "path": "cr:path", "recordSet": "cr:recordSet",
    "references": "cr:references", "regex": "cr:regex", "repeated": "cr:repeated", "replace": "cr:replace",
    "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField", "transform": "cr:transform",
}  # fmt: skip
"""The context that Croissant 1.0 prescribes."""

TYPES = {
    "int32": "sc:Integer", "int16": "sc:Integer", "uint8": "sc:Integer", "float32": "sc:Float", "float64": "sc:Float",
    "bool": "sc:Boolean", "string": "sc:Text", "category": "sc:Text",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Described:
    """What both descriptions say of a folder."""

    name: str
    text: str
    date: str
    """ISO 8601."""
    version: str
    """Version of cosim."""
    commit: str
    files: tuple[tuple[str, str, str], ...]
    """Path, media type and SHA-256 (empty: not known) of each file."""
    inputs: tuple[str, ...]
    """Those of the files that the program read."""
    tables: dict[str, str]
    """By name of a table: the pattern of its files."""
    attribution: str
    """Of the network."""
    seed: str

    @property
    def sha256(self) -> str:
        """Checksum of the manifest or of the study file: a name for the data that nothing else has."""
        return self.files[0][2]


def describe(source: Run | Study) -> Described:
    """What there is to say of a run or a study."""
    return _of_study(source) if isinstance(source, Study) else _of_run(source)


def write(
    source: Run | Study, out: Path, authors: Sequence[str] = (), licence: str | None = None
) -> tuple[Path, Path]:  # fmt: skip
    """Write both descriptions into a folder.

    Parameters
    ----------
    out
        Folder for the two files. Paths in them are relative to the folder of the run or study, so they belong there.
    authors
        Names of the people who made the data.
    licence
        Address (URL) of the licence of the data. None: the descriptions say that none is stated.

    Raises
    ------
    ValueError
        In one line: the licence is no address, or the folder cannot be written.
    """
    if licence is not None and not licence.startswith(("https://", "http://")):
        raise ValueError(
            f"--licence {licence}: the address of a licence is wanted, such as https://spdx.org/licenses/CC-BY-4.0."
        )
    about = describe(source)
    paths = (out / CROISSANT, out / RO_CRATE)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, made in zip(paths, (croissant, ro_crate), strict=True):
            text = json.dumps(made(about, authors, licence), indent=1, ensure_ascii=False) + "\n"
            durable.write_output(path, text.encode())
    except OSError as error:
        raise ValueError(f"--out {out} cannot be written: {error.strerror or error}.") from None
    return paths


def _of_run(run: Run) -> Described:
    config, source = run.manifest["config"], run.manifest.get("source", {})
    net = run.manifest.get("net", {})
    seconds = run.manifest["steps"] * run.dt_s
    where = net.get("name") or config.get("traffic", {}).get("scenario", "a road network")
    parts = [(part.name, PARQUET, part.sha256) for name in run.tables for part in run.inventory.of(name)]
    own = [(MANIFEST, "application/json", durable.sha256(run.path / MANIFEST))]
    if (run.path / CONFIG).is_file():
        own.append((CONFIG, "application/toml", durable.sha256(run.path / CONFIG)))
    return Described(
        name=f"cosim run {run.path.resolve().name}",
        text=f"A simulation of cooperative perception under trust: {seconds:g} s of {where}, with trust in "
        f"{len(run.subjects)} pseudonyms. Tables of schema version {run.manifest['schema_version']}.",
        date=_date(run.path / MANIFEST), version=str(source.get("version", "")), commit=str(source.get("commit", "")),
        files=(*own, *parts), inputs=(CONFIG,) if len(own) > 1 else (),
        tables={name: f"{name}/*.parquet" for name in run.tables if run.inventory.of(name)},
        attribution=str(net.get("attribution", "")), seed=str(run.manifest.get("seed", "")),
    )  # fmt: skip


def _of_study(study: Study) -> Described:
    heads = {"study.toml": "application/toml", "study.json": "application/json", "index.parquet": PARQUET}
    there = {name: kind for name, kind in heads.items() if (study.path / name).is_file()}
    files = [(name, kind, durable.sha256(study.path / name)) for name, kind in there.items()]
    runs = sorted({str(run) for run in study.points["run"]})
    opened = None
    for run in runs:
        for path in (f"jobs/{run}/measures.parquet", f"runs/{run}/{MANIFEST}"):
            if (study.path / path).is_file():
                kind = PARQUET if path.endswith(".parquet") else "application/json"
                files.append((path, kind, durable.sha256(study.path / path)))
        if opened is None and (study.path / "runs" / run / MANIFEST).is_file():
            opened = study.run(str(study.points[study.points["run"] == run].point.iloc[0]))
    source = {} if opened is None else opened.manifest.get("source", {})
    names = () if opened is None else tuple(name for name in opened.tables if opened.inventory.of(name))
    return Described(
        name=f"cosim study {study.name}",
        text=f"{study.question} {len(study.points)} points in {len(runs)} runs over {', '.join(study.keys)}.".strip(),
        date=_date(study.path / next(iter(there))), version=str(source.get("version", "")),
        commit=str(source.get("commit", "")),
        files=tuple(files), inputs=tuple(name for name, *_ in files if name == "study.toml"),
        tables={name: f"runs/*/{name}/*.parquet" for name in names},
        attribution="" if opened is None else str(opened.manifest.get("net", {}).get("attribution", "")), seed="",
    )  # fmt: skip


def _date(path: Path) -> str:
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def croissant(about: Described, authors: Sequence[str] = (), licence: str | None = None) -> Entity:
    """A Croissant card."""
    distribution: list[Entity] = [
        {"@type": "cr:FileObject", "@id": path, "name": path, "contentUrl": path, "encodingFormat": kind, "sha256": sha}
        for path, kind, sha in about.files if kind != PARQUET
    ]  # fmt: skip
    distribution += [
        {"@type": "cr:FileSet", "@id": f"{name}-files", "name": f"{name}-files", "description": TABLES[name].meaning,
         "encodingFormat": PARQUET, "includes": pattern} for name, pattern in about.tables.items()
    ]  # fmt: skip
    card: Entity = {
        "@context": CONTEXT, "@type": "sc:Dataset", "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": about.name, "description": about.text, "version": f"{SCHEMA_VERSION}.0.0",
        "datePublished": about.date, "url": f"urn:sha256:{about.sha256}", "license": licence or NO_LICENCE,
        "citeAs": f"{about.name}, made with cosim {about.version}",
        "keywords": ["V2X", "cooperative perception", "trust"],
        "distribution": distribution, "recordSet": [_record_set(name) for name in about.tables],
    }  # fmt: skip
    if authors:
        card["creator"] = [{"@type": "sc:Person", "name": name} for name in authors]
    return card


def _record_set(name: str) -> Entity:
    table = TABLES[name]
    return {
        "@type": "cr:RecordSet", "@id": name, "name": name, "description": table.meaning,
        "key": [{"@id": f"{name}/{column}"} for column in table.key],
        "field": [_field(name, column, about) for column, about in table.stored.items()],
    }  # fmt: skip


def _field(table: str, name: str, column: Column) -> Entity:
    unit = f" [{column.unit}]" if column.unit not in ("", "1") else ""
    return {
        "@type": "cr:Field", "@id": f"{table}/{name}", "name": f"{table}/{name}",
        "description": column.meaning + unit, "dataType": TYPES[column.type],
        "source": {"fileSet": {"@id": f"{table}-files"}, "extract": {"column": name}},
    }  # fmt: skip


def ro_crate(about: Described, authors: Sequence[str] = (), licence: str | None = None) -> Entity:
    """The metadata of an RO-Crate."""
    people: list[Entity] = [{"@id": f"#{name}", "@type": "Person", "name": name} for name in authors]
    files: list[Entity] = [_file(path, kind, sha) for path, kind, sha in about.files]
    program = {
        "@id": PROGRAM, "@type": "SoftwareApplication", "name": "cosim", "version": about.version or "unknown",
        **({"identifier": about.commit} if about.commit else {}),
    }  # fmt: skip
    variables = [
        {"@id": f"#{name}", "@type": "PropertyValue", "name": name, "description": TABLES[name].meaning,
         "value": pattern} for name, pattern in about.tables.items()
    ]  # fmt: skip
    action = {
        "@id": "#simulation", "@type": "CreateAction", "name": f"Simulation of {about.name}", "endTime": about.date,
        "instrument": {"@id": PROGRAM}, "object": [{"@id": path} for path in about.inputs],
        "result": [{"@id": "./"}], **({"description": f"seed {about.seed}"} if about.seed else {}),
    }  # fmt: skip
    root: Entity = {
        "@id": "./", "@type": "Dataset", "name": about.name, "description": about.text, "datePublished": about.date,
        "license": {"@id": licence} if licence else NO_LICENCE, "hasPart": [{"@id": file["@id"]} for file in files],
        "mentions": [{"@id": "#simulation"}], "variableMeasured": [{"@id": v["@id"]} for v in variables],
        "conformsTo": {"@id": "https://w3id.org/ro/wfrun/process/0.5"},
    }  # fmt: skip
    if people:
        root["author"] = [{"@id": person["@id"]} for person in people]
    if about.attribution:
        root["creditText"] = about.attribution
    head = {
        "@id": RO_CRATE, "@type": "CreativeWork", "about": {"@id": "./"},
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
    }  # fmt: skip
    profile = {"@id": "https://w3id.org/ro/wfrun/process/0.5", "@type": "CreativeWork", "name": "Process Run Crate"}
    licences = [{"@id": licence, "@type": "CreativeWork", "name": licence}] if licence else []
    graph = [head, root, program, action, profile, *licences, *people, *files, *variables]
    return {"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": graph}


def _file(path: str, kind: str, sha: str) -> Entity:
    return {"@id": path, "@type": "File", "name": path, "encodingFormat": kind, **({"sha256": sha} if sha else {})}
