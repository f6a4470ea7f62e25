"""One look-up over keys, metrics, tables, columns, figures, choices, commands and words."""

import difflib
import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import typer

from cosim.cli.help import first_sentence, write_options

MOST_NEAR = 8
"""Number of close names that an error lists."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Something that has a name and a meaning."""

    name: str
    kind: str
    """What it is, such as "key of the config"."""
    meaning: str
    where: str = ""
    """A command or a page that tells more."""


def look_up(asked: str, of_program: Callable[[], Iterator[Explanation]]) -> list[Explanation]:
    """Everything of this name; else what ends in it or contains it.

    Raises
    ------
    ValueError
        In one line: no word is given, or nothing has such a name, with the closest names.
    """
    wanted = _plain(asked.removeprefix("--set ").partition("=")[0].removeprefix("cosim "))
    if not wanted:
        raise ValueError("no word is given. Give a key, metric, column, model, command or term, such as freshness.")
    entries = [*of_program(), *_entries()]
    for is_it in (_is_named, _ends_in, _contains):
        if found := [entry for entry in entries if is_it(_plain(entry.name), wanted)]:
            return found
    names: dict[str, str] = {}
    for entry in entries:
        names[_plain(entry.name)] = entry.name
        names[_plain(entry.name.rpartition(".")[2])] = entry.name
    close = difflib.get_close_matches(wanted, names, MOST_NEAR, 0.7)
    near = list(dict.fromkeys(names[one] for one in close))
    hint = f"Near: {', '.join(near)}." if near else "Try a part of a name, such as freshness."
    raise ValueError(f"{asked}: no key, metric, table, column, figure, choice, command or term has this name. {hint}")


def _plain(name: str) -> str:
    return re.sub(r"\.\d+(?=\.|$)", "", re.sub(r"[\s_-]+", " ", name.strip().strip("[]`").lower()))


def _is_named(name: str, wanted: str) -> bool:
    return wanted in (name, *(part.strip() for part in name.split(",")))


def _ends_in(name: str, wanted: str) -> bool:
    return name.endswith("." + wanted)


def _contains(name: str, wanted: str) -> bool:
    return re.search(rf"(^|[ .,]){re.escape(wanted)}", name) is not None


def _entries() -> Iterator[Explanation]:
    yield from _terms()
    yield from _keys()
    yield from _choices()
    yield from _measured()
    yield from _figures()
    yield from _files()


def _terms() -> Iterator[Explanation]:
    from cosim.addons.explain.glossary import GLOSSARY

    for name, meaning in GLOSSARY.items():
        yield Explanation(name, "term", meaning)


def _keys() -> Iterator[Explanation]:
    from cosim.addons.explain.key_docs import sections

    for section in sections():
        of = f", {section.title}" if " = " in section.title else ""
        if section.about and not of:
            names = ", ".join(key.name.rpartition(".")[2] for key in section.keys)
            about = f"{section.about} Keys: {names}." if names else section.about
            yield Explanation(section.title.strip("[]"), "section of the config", about)
        is_listed = section.title.startswith("[[")
        for key in section.keys:
            facts = filter(None, (key.kind, key.bounds, f"default {key.default}"))
            about = "; ".join(facts).replace("`", "")
            where = key.name.replace(".", ".0.", 1) if is_listed else key.name
            kind = f"key of the config{of}"
            yield Explanation(key.name, kind, f"{key.meaning} ({about})", f"cosim check --set {where}=...")


def _choices() -> Iterator[Explanation]:
    from cosim.config.preset import names
    from cosim.door.kinds import KINDS

    for kind in KINDS.values():
        for name, made in kind.shipped.items():
            where = f'{kind.section}: {kind.key} = "{name}"' if kind.section else f"cosim export {name}"
            said = _paragraphs(made, kind.name == "trust")
            said += _sources(kind.name, name)
            yield Explanation(name, kind.title, said, where)
    for name in names():
        yield Explanation(
            name, "preset", "A named set of keys that a config starts from.", f"cosim check --preset {name} --all"
        )


def _paragraphs(made: Any, is_trust: bool) -> str:
    """What a class says of itself, up to the headings of its docstring."""
    text = inspect.getdoc(made) or ""
    said = " ".join(re.split(r"\n\w[\w ]*\n-{3,}\n", text)[0].split())
    if not is_trust:
        return re.sub(r" ?\[\d+\]_", "", said)
    return re.sub(r"\[(\d+)\]_", lambda found: _authors(int(found[1])), said)


def _authors(number: int) -> str:
    """Authors and year of a reference of the trust models, by its number in trust/README.md."""
    from cosim.addons.explain.cite import references

    found = next(one for one in references().values() if one.get("trust") == number)
    authors = str(found.get("author", found["title"])).split(" and ")
    names = [name.partition(",")[0] for name in authors]
    who = " and ".join(names) if len(names) < 3 else f"{names[0]} et al."
    return f"{who} ({found['year']})" if "year" in found else who


def _sources(kind: str, name: str) -> str:
    """The references of a choice that ships."""
    from cosim.addons.explain import cite

    known = cite.USED_BY
    keys = known.get(kind, {}).get(name, ())
    return "".join(f" Source: {cite.text(cite.references()[key])}" for key in keys)


def _measured() -> Iterator[Explanation]:
    from results.metrics.registry import METRICS, TOPICS
    from results.tables import TABLES

    for name, meaning in TOPICS.items():
        yield Explanation(name, "topic of metrics", meaning, "cosim measure RUN")
    for name, metric in METRICS.items():
        unit = f" [{metric.unit}]" if metric.unit not in ("", "1") else ""
        by = f" By {metric.group}." if metric.group else ""
        yield Explanation(name, f"metric{unit}", metric.definition + by, f"cosim measure RUN --metric {name}")
    for name, table in TABLES.items():
        columns = ", ".join(table.columns)
        yield Explanation(name, "table of a run", f"{table.meaning} Columns: {columns}.", f"open_run(RUN).{name}")
        for column, about in table.columns.items():
            unit = f" [{about.unit}]" if about.unit not in ("", "1") else ""
            labels = f" One of {', '.join(about.categories)}." if about.categories else ""
            yield Explanation(f"{name}.{column}", f"column{unit}", about.meaning + labels)


def _figures() -> Iterator[Explanation]:
    from results.figures.catalogue import FIGURES

    for name, draw in FIGURES.items():
        yield Explanation(name, "figure", _paragraphs(draw, False), f"cosim plot {name} RUN")


def _files() -> Iterator[Explanation]:
    from cosim.studies.study import SHIPPED
    from sumo_nets import catalogue
    from sumo_nets.sumo_package_nets import NETS

    cities = {name: catalogue.find(name).description for name in catalogue.shipped()}
    cities |= {net.name: net.description for net in NETS.values()}
    for name, about in cities.items():
        yield Explanation(name, "city", f"{about}.", f"cosim nets show {name}")
    for path in sorted(SHIPPED.glob("*.toml")):
        head = re.search(r'^question = "(.*)"$', path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        yield Explanation(path.stem, "study that ships", head[1] if head else "", f"cosim sweep {path.stem}")


def commands(program: Any) -> Iterator[Explanation]:
    """All commands, with all their options."""

    def walk(command: Any, context: Any, words: str) -> Iterator[Explanation]:
        for name, inner in command.commands.items():
            inside = typer.Context(inner, info_name=name, parent=context, terminal_width=78)
            full = f"{words} {name}".strip()
            yield Explanation(full, "command", _help(inner, inside))
            if hasattr(inner, "commands"):
                yield from walk(inner, inside, full)

    yield from walk(program, typer.Context(program, info_name="cosim", terminal_width=78), "")


def _help(command: Any, context: Any) -> str:
    formatter = context.make_formatter()
    formatter.write_usage(context.command_path, " ".join(command.collect_usage_pieces(context)))
    formatter.write_paragraph()
    formatter.write_text(command.help or "")
    if hasattr(command, "commands"):
        formatter.write_paragraph()
        formatter.write_dl([(name, first_sentence(inner)) for name, inner in command.commands.items()])
    write_options(command.get_params(context), context, formatter, whole=True)
    return formatter.getvalue().rstrip()
