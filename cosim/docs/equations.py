"""Converts LaTeX equations of pages (```math fences and $`...`$) to MathML, which browsers show without scripts."""

import re

_BLOCK = re.compile(r"^```math\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)
_INLINE = re.compile(r"\$`([^`]+)`\$")


def rendered(text: str) -> str:
    """The page with its equations as MathML."""
    if not (_BLOCK.search(text) or _INLINE.search(text)):
        return text
    from latex2mathml.converter import convert

    def block(found: re.Match[str]) -> str:
        return f'<div class="equation">{convert(found.group(1).strip(), display="block")}</div>'

    def inline(found: re.Match[str]) -> str:
        return f"<span>{convert(found.group(1))}</span>"  # at the beginning of a line, <math> would end a paragraph

    return _INLINE.sub(inline, _BLOCK.sub(block, text))
