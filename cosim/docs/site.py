"""Builds the documentation site: `python -m cosim.docs.site OUT`.

The pages come from `pages/`, from the packages' READMEs and from the code. Their links name files of the repository, so
that they can be followed in a checkout. Here they are changed to the site's pages, and links to source files become
plain names.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from cosim.base.addons import loaded
from cosim.docs import commands, equations

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CONFIG = "mkdocs.yml"
PAGES = "cosim/docs/pages/"

TAKEN: Mapping[str, str] = {
    "results/TABLES.md": "reference/tables.md",
    "results/FRESHNESS.md": "models/freshness.md",
    "cosim/PAPER.md": "models/paper.md",
    "sensors/README.md": "models/sensors.md",
    "cosim/radio/README.md": "models/radio.md",
    "cosim/messages/README.md": "models/v2x.md",
    "cosim/attacks/README.md": "models/attacks.md",
    "trust/README.md": "models/trust.md",
    "cosim/addons/driver/README.md": "models/driver.md",
    "results/README.md": "reference/results.md",
    "cosim/studies/README.md": "howto/studies.md",
    "sumo_nets/README.md": "models/cities.md",
    "sumo_nets/helsinki/README.md": "models/helsinki.md",
    "CHANGELOG.md": "changelog.md",
}
"""Pages from elsewhere in the repository, and their places on the site."""
MADE: Mapping[str, str] = {
    "cosim/config/config.py": "reference/config.md",
    "cosim/cli/main.py": "reference/cli.md",
    f"{PAGES}howto/python.py": "howto/python.md",
    "README.md": "index.md",
}
"""Files of the repository for which the site has a page of its own."""
FILES: Mapping[str, str] = {"results/pictures/": "pictures/", "sensors/profiles/": "models/profiles/", PAGES: ""}
"""Folders of the repository, and their places on the site."""

_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
_FENCE = re.compile(r"(^```.*?^```$)", flags=re.DOTALL | re.MULTILINE)


def pages() -> dict[str, str]:
    """Every page of the site by path, as Markdown with links within the site and equations as LaTeX."""
    own = [path.relative_to(ROOT).as_posix() for path in (HERE / "pages").rglob("*.md")]
    places = {source: _place(source) for source in own} | dict(TAKEN)
    found = {at: _turned(source, at) for source, at in places.items()}
    found["reference/config.md"] = loaded("cosim.addons.explain.config_page:markdown")()
    found["reference/cli.md"] = commands.markdown()
    found["howto/python.md"] = _notebook((HERE / "pages/howto/python.py").read_text(encoding="utf-8"))
    return dict(sorted(found.items()))


def build(out: Path) -> None:
    """Write the site to a folder. A warning about a page is an error."""
    work = out.with_name(out.name + "-pages")
    shutil.rmtree(work, ignore_errors=True)
    for at, text in pages().items():
        (work / "docs" / at).parent.mkdir(parents=True, exist_ok=True)
        (work / "docs" / at).write_text(equations.rendered(text), encoding="utf-8")
    shutil.copytree(ROOT / "results" / "pictures", work / "docs" / "pictures")
    profiles = work / "docs" / "models" / "profiles"
    profiles.mkdir(parents=True)
    for picture in (ROOT / "sensors" / "profiles").glob("*.png"):
        shutil.copy(picture, profiles)
    shutil.copy(HERE / CONFIG, work / CONFIG)
    for name in ("site.css", "iframe-worker.js"):
        shutil.copy(HERE / name, work / "docs" / name)
    command = [sys.executable, "-P", "-m", "mkdocs", "build", "--strict", "--quiet", "-f", str(work / CONFIG)]
    command += ["-d", str(out.resolve())]
    if subprocess.run(command, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}).returncode:
        sys.exit("error: the site has warnings, see above; where MkDocs is not installed: make docs")


def _turned(source: str, at: str) -> str:
    """A page of the repository with its links changed to the site's pages."""

    def link(found: re.Match[str]) -> str:
        picture, label, target = found.groups()
        place, hash_, anchor = target.partition("#")
        if "://" in target or not place:
            return found.group()
        path = Path(os.path.normpath(Path(source).parent / place)).as_posix()
        if not (ROOT / path).exists():
            raise ValueError(f"{source}: links to {target}, which is not there.")
        if page := _place(path):
            to = os.path.relpath(page, Path(at).parent)
            return f"{picture}[{label}]({to}{hash_}{anchor})"
        return label if label.startswith("`") else f"{label} (`{path}`)"

    parts = _FENCE.split((ROOT / source).read_text(encoding="utf-8"))
    return "".join(part if part.startswith("```") else _LINK.sub(link, part) for part in parts)


def _place(path: str) -> str:
    """The place on the site of a file of the repository, or nothing."""
    path = f"{path}/README.md" if f"{path}/README.md" in TAKEN else path
    for folder, place in FILES.items():
        if path.startswith(folder) and path not in MADE:
            return place + path.removeprefix(folder)
    return TAKEN.get(path) or MADE.get(path, "")


def _notebook(text: str) -> str:
    """A Python file of cells as a page: `# %% [markdown]` cells as text, others as code."""
    lines = []
    for cell in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            lines.append(re.sub(r"^# ?", "", body.strip(), flags=re.MULTILINE))
        else:
            lines.append(f"```python\n{body.strip()}\n```")
    return "\n\n".join(lines) + "\n"


if __name__ == "__main__":
    build(Path(sys.argv[1]))
