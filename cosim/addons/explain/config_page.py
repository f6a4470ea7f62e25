"""Renders the page of the config keys as Markdown: type, default, bounds and meaning."""

from cosim.addons.explain.key_docs import KeyDoc, SectionDoc, sections
from cosim.config import preset


def markdown() -> str:
    """The page."""
    lines = [
        "# Every key of the config",
        "",
        "A config is a TOML file. A dot in a key separates section and key: `radio.range_m` is `range_m` in `[radio]`.",
        "`--set KEY=VALUE` changes a key on the command line. Items of lists have numbers: `attacks.0.share_p`.",
        f"A key that you leave out has its default, that of the preset `{preset.DEFAULT}`. Another `preset` has other",
        "defaults. An unknown key is an error. `cosim check FILE --all` prints all values.",
        "",
    ]
    for section in sections():
        lines += _section(section)
    return "\n".join(lines) + "\n"


def _section(section: SectionDoc) -> list[str]:
    if not section.keys:
        return []
    head = ["| key | type | default | meaning |", "|---|---|---|---|"]
    about = [section.about, ""] if section.about else []
    rows = map(_row, section.keys)
    return [f"## {section.title}", "", *about, *head, *rows, ""]


def _row(key: KeyDoc) -> str:
    kind = "; ".join(filter(None, (key.kind, key.bounds)))
    cells = [f"`{key.name}`", kind, key.default, key.meaning]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
