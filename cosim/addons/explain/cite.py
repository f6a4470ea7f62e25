"""References of exactly the parts that a run used, from its manifest."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_FILE = tomllib.loads(Path(__file__).with_name("references.toml").read_text(encoding="utf-8"))
USED_BY: Mapping[str, Mapping[str, Sequence[str]]] = _FILE["used_by"]
"""References of what ships: of trust models, detectors, media, attacks and drivers."""


@dataclass(frozen=True, slots=True)
class CitedPart:
    """A part of the program that a run used."""

    what: str
    """The part in words, such as `trust model beta`."""
    references: Sequence[str] = ()
    """Keys of `references.toml`; empty if nothing was published about it."""
    entry: Mapping[str, Any] = field(default_factory=dict)
    """A reference that depends on the run, such as that of its city, in place of keys."""


def parts(manifest: Mapping[str, Any]) -> Iterator[CitedPart]:
    """The parts that a run used, in the order of the data: program, traffic, sensing, messages, trust."""
    config, versions = manifest["config"], manifest.get("versions", {})
    source = manifest.get("source", {})
    commit = str(source.get("commit") or "")[:12]
    version = f"{source.get('version', '')} {commit}".strip()
    yield CitedPart(
        "cosim",
        entry={
            "type": "software",
            "title": "cosim: co-simulation of cooperative perception under trust at city scale",
            "author": "{The maintainers of cosim}",
            "version": version,
        },
    )
    yield from _traffic(manifest, versions)
    if not config.get("sensing", True):
        return
    choices = manifest.get("choices", {})
    yield from _sensing(config)
    yield from _messages(config)
    yield from _attacks(config)
    yield from _trust(config)
    if (driver := config["driver"]["model"]) in USED_BY["driver"]:
        yield CitedPart(f"driver {driver}", USED_BY["driver"][driver])
    for place, found in choices.items():
        if found.get("file"):
            yield CitedPart(f"{place}: {found['name']}, a class of the user's own")


def _traffic(manifest: Mapping[str, Any], versions: Mapping[str, str]) -> Iterator[CitedPart]:
    net, traffic = manifest.get("net", {}), manifest["config"]["traffic"]
    files = [key for key in net if key.startswith("sha256 ") and not key.endswith(".file")]  # without meshes
    is_alone = len(files) == 1  # a recording without a city, which has a network too
    replayed = traffic.get("trace")
    if is_alone or "sha256 manifest.json" in files:
        replayed = replayed or traffic["scenario"]
    if replayed:
        yield CitedPart(f"replayed traffic, {Path(replayed).name}")
    elif "libsumo" in versions:
        yield CitedPart(f"traffic, Eclipse SUMO {versions['libsumo']}", ("lopez2018",))
    if "licence" in net and not is_alone:
        licence = ", ".join(filter(None, (net.get("attribution"), net.get("licence"))))
        yield CitedPart(
            f"city {net['name']}",
            entry={
                "type": "misc",
                "title": f"Network and demand of {net['name']}",
                "note": licence or "licence not stated",
            },
        )


def _sensing(config: Mapping[str, Any]) -> Iterator[CitedPart]:
    detector, weather = config["detector"]["model"], config.get("weather", {})
    if detector in USED_BY["detector"]:
        yield CitedPart(f"detector {detector}", USED_BY["detector"][detector])
    if config["tracking"]["model"] != "none" or config["trust"].get("matching") == "gates":
        yield CitedPart("tracking and association by gates", ("barshalom2001",))
    if weather.get("rain_mm_h") or weather.get("visibility_m") is not None:
        yield CitedPart("weather", ("kilic2021", "hahner2021"))
    if config["early_fusion"]["share"] != "none":
        yield CitedPart("early fusion", ("chen2019",))


def _messages(config: Mapping[str, Any]) -> Iterator[CitedPart]:
    radio, cpm = config["radio"], config["cpm"]
    model, propagation = radio["model"], radio["propagation"]
    if model in USED_BY["medium"]:
        yield CitedPart(f"radio {model}", USED_BY["medium"][model])
        found = {
            "tr37885": propagation["model"] in ("urban", "highway"),
            "sommer2011twoway": propagation["model"] == "two_ray_interference",
            "sommer2011walls": propagation["walls"] == "sommer",
            "boban2016": propagation["blockage"] == "probabilistic",
            "cheng2007": propagation["fading"] == "cheng",
        }
        used = tuple(key for key, is_used in found.items() if is_used)
        yield CitedPart(f"propagation {propagation['model']}", used)
    if model == "csma" and radio["dcc"]["enabled"]:
        adaptive = radio["dcc"]["algorithm"] == "adaptive"
        yield CitedPart("congestion control", ("ts102687", "bansal2013") if adaptive else ("ts102687",))
    if radio["relay"]["max_hops"] > 1 and radio["relay"]["rule"] == "contention":
        yield CitedPart("forwarding by contention", ("en302636",))
    if cpm["rules"] != "all" or cpm["length"] == "uper":
        yield CitedPart("collective perception messages", ("ts103324",))


def _attacks(config: Mapping[str, Any]) -> Iterator[CitedPart]:
    for attack in config.get("attacks", ()):
        is_used = attack.get("share_p", 0) > 0 or attack.get("ids") or attack.get("together_with") is not None
        if is_used and ".py:" not in attack["attack"]:
            yield CitedPart(f"attack {attack['attack']}", USED_BY["attack"].get(attack["attack"], ()))


def _trust(config: Mapping[str, Any]) -> Iterator[CitedPart]:
    base = config["trust"]
    found = [base, *(base | variant for variant in config.get("trust_variant", ()))]
    for model in dict.fromkeys(one["model"] for one in found if one["host"] != "none"):
        if model in USED_BY["trust"]:
            yield CitedPart(f"trust model {model}", USED_BY["trust"][model])


def references() -> Mapping[str, Mapping[str, Any]]:
    """All references by key."""
    return _FILE["references"]


_PLACES = ("booktitle", "journal", "publisher", "howpublished")
_MORE = ("version", *_PLACES, "year", "url", "note")


def text(reference: Mapping[str, Any]) -> str:
    """A reference in one line."""
    authors = ", ".join(map(_in_order, _authors(reference)))
    more = ", ".join(str(reference[key]) for key in _MORE if reference.get(key))
    head = f"{authors}: " if authors else ""
    return f"{head}{reference['title']}. {more}".strip(" .") + "."


def _authors(reference: Mapping[str, Any]) -> list[str]:
    given = str(reference.get("author", "")).strip("{}")
    return given.replace(" and others", " et al.").split(" and ") if given else []


def _in_order(name: str) -> str:
    """The first name before the family name."""
    family, comma, first = name.partition(",")
    if not comma:
        return name
    first, _, others = first.strip().partition(" et al.")
    return f"{first} {family}" + (" et al." if name.endswith("et al.") else others)


def parts_of_all(manifests: Sequence[Mapping[str, Any]]) -> list[CitedPart]:
    """The parts that some runs used, each once."""
    return list({part.what: part for manifest in manifests for part in parts(manifest)}.values())


def bibtex(used: Sequence[CitedPart]) -> str:
    """The references of some parts as BibTeX, each once."""
    found: dict[str, Mapping[str, Any]] = {}
    for part in used:
        if part.entry:
            key = "".join(c for c in part.what.lower() if c.isalnum()) or "part"
            found[key] = part.entry
        found |= {key: references()[key] for key in part.references}
    return "\n\n".join(_bibtex(key, one) for key, one in found.items())


def _bibtex(key: str, reference: Mapping[str, Any]) -> str:
    kind = {"standard": "misc", "software": "misc"}.get(reference["type"], reference["type"])
    lines = [
        f"  {name} = {{{_escaped(str(value))}}}"
        for name, value in reference.items()
        if name not in ("type", "trust") and value
    ]
    return f"@{kind}{{{key},\n" + ",\n".join(lines) + "\n}"


def _escaped(value: str) -> str:
    return "".join("\\" + c if c in "&%#_$" else c for c in value)
