"""Makes the figures of the pages anew, and lists what moved.

`make figures`, or `python -m tests.verification.figures [NAME...]`. Each command is a process of its own. What it
prints goes to `build/figures/NAME.txt`, and lines that differ from those of the last time are printed. Without names,
all are made, which takes some ten hours. Pages are changed by hand, because their sentences may have
to change with the figures. `make pages` records the outputs that pages show as they are, and `make bench` measures
speed, which differs each time.
"""

import difflib
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "figures"
PAGES = "cosim/docs/pages"


class Figure(NamedTuple):
    """Figures of a page, and what makes them."""

    page: str
    command: str
    """As the page names it. `cosim run` and `cosim sweep` are followed by `cosim measure` if nothing else follows."""
    more: tuple[str, ...] = ()
    """Further arguments; FOLDER stands for an empty folder."""
    then: tuple[str, ...] = ()
    """Commands that follow."""


FIGURES = {
    "default": Figure(f"{PAGES}/tutorial/first-run.md", "cosim run"),
    "compare": Figure(f"{PAGES}/models/validation.md", "cosim compare", ("--out", "FOLDER")),
    "accuracy": Figure(
        f"{PAGES}/models/accuracy.md", "python -m tests.verification.stated_accuracy", ("FOLDER", "10", "150")
    ),
    "pose_errors": Figure(f"{PAGES}/models/accuracy.md", "cosim sweep pose_errors"),
    "misstated": Figure(f"{PAGES}/models/accuracy.md", "cosim sweep misstated"),
    "stated": Figure(f"{PAGES}/models/accuracy.md", "cosim sweep stated"),
    "attacks": Figure(f"{PAGES}/models/accuracy.md", "cosim sweep attacks"),
    "attacks_by_overlap": Figure(f"{PAGES}/models/accuracy.md", "cosim sweep attacks", ("--set", "trust.matching=iou")),
    "ghosts": Figure(f"{PAGES}/models/accuracy.md", "python -m tests.verification.ghosts_and_recall", ("FOLDER",)),
    "presets": Figure(f"{PAGES}/models/presets.md", "cosim sweep presets"),
    "deviations": Figure(f"{PAGES}/models/validation.md", "cosim sweep deviations"),
    "freshness": Figure("results/FRESHNESS.md", "cosim sweep freshness"),
    "question": Figure(f"{PAGES}/tutorial/question.md", "cosim sweep question"),
    "encounters": Figure("cosim/studies/README.md", "cosim sweep encounters"),
    "strangers": Figure(f"{PAGES}/models/validation.md", "cosim sweep strangers"),
    "revocation": Figure(f"{PAGES}/models/validation.md", "cosim sweep revocation"),
    "benchmark": Figure(
        f"{PAGES}/howto/benchmark.md",
        "cosim benchmark --make",
        ("--evidence", "FOLDER"),
        ("cosim benchmark --all --evidence FOLDER",),
    ),
    "twelve_attacks": Figure(
        "trust/README.md",
        "python -m tests.verification.attack_evidence",
        ("FOLDER", "helsinki", "1"),
        ("python -m tests.verification.twelve_attacks FOLDER FOLDER/table.csv FOLDER/helsinki-1.pickle",),
    ),
    "two_false_kinds": Figure("trust/README.md", "python -m tests.verification.two_false_kinds", ("FOLDER",)),
    "ghosts_in_shadows": Figure(
        "cosim/attacks/README.md", "python -m tests.verification.ghosts_in_shadows", ("FOLDER",)
    ),
    "dummies": Figure(f"{PAGES}/models/validation.md", "python -m tests.verification.dummies", ("FOLDER",)),
    "witnesses": Figure(f"{PAGES}/howto/roadside.md", "cosim sweep witnesses"),
    "half_hour_of_ghosts": Figure(
        "cosim/addons/driver/README.md",
        "cosim sweep safety_half_hour",
        then=("python -m tests.verification.half_hour_of_ghosts FOLDER",),
    ),
    "whitewashing": Figure("cosim/attacks/README.md", "cosim sweep whitewashing"),
    "rings": Figure("cosim/attacks/README.md", "python -m tests.verification.rings", ("FOLDER",)),
    "on_off": Figure("cosim/attacks/README.md", "python -m tests.verification.on_off", ("FOLDER",)),
    "weather": Figure(f"{PAGES}/models/seeing.md", "cosim sweep weather"),
    "law": Figure(f"{PAGES}/models/freshness-law.md", "python -m tests.verification.freshness_law"),
    "hidden_pedestrian": Figure(
        "cosim/addons/driver/README.md", "python -m tests.verification.pedestrian_behind_bus", ("100",)
    ),
}


def words(name: str, folder: Path) -> list[list[str]]:
    """The commands of a figure, one after the other."""
    figure = FIGURES[name]
    first = [*figure.command.split(), *figure.more]
    then = figure.then
    if first[1] in ("run", "sweep"):
        then = then or ("cosim measure FOLDER",)
        first += ["--out", "FOLDER"]
    commands = []
    for program, *given in (first, *(command.split() for command in then)):
        started = [sys.executable] if program == "python" else [sys.executable, "-m", "cosim"]
        commands.append([*started, *(word.replace("FOLDER", str(folder)) for word in given)])
    return commands


def make(name: str) -> bool:
    """Make one figure and print what moved; whether its commands succeeded."""
    folder, kept = BUILD / "runs" / name, BUILD / f"{name}.txt"
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    said = ""
    for command in words(name, folder):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"{name}: status {done.returncode}: {done.stderr.strip()}", flush=True)
            return False
        said = done.stdout
    before = kept.read_text(encoding="utf-8") if kept.exists() else None
    kept.write_text(said, encoding="utf-8")
    moved = [] if before is None else difflib.unified_diff(before.splitlines(), said.splitlines(), lineterm="", n=0)
    lines = [line for line in moved if re.match(r"[-+](?![-+])", line)]
    found = "made for the first time" if before is None else f"{len(lines)} lines moved" if lines else "the same"
    print(f"{name}: {found} ({FIGURES[name].page})", *lines, sep="\n", flush=True)
    return True


def main(names: list[str]) -> int:
    """Make the figures of these names, or all; the exit status."""
    if unknown := sorted(set(names) - set(FIGURES)):
        print(f"error: no figure is called {', '.join(unknown)}. There are {', '.join(FIGURES)}.", file=sys.stderr)
        return 2
    return 0 if all([make(name) for name in names or FIGURES]) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
