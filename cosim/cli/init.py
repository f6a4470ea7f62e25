"""The command `init`: a config or a study to begin with."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.console import AsJson, print_done

CONFIG = """\
# An experiment. Each key is optional, and `cosim explain KEY` tells what it means.
seed = 4                      # another seed is another sample

[traffic]
scenario = "helsinki"         # a city of `cosim nets list`, a .sumocfg, a trace, or a folder of `cosim nets build`
duration_s = 120

[fleet]
penetration_p = 0.35          # share of the vehicles that have a LiDAR and a radio

[[attacks]]
attack = "ghost_insertion"    # they report vehicles that do not exist
share_p = 0.1                 # share of the equipped vehicles that attack; 0: nobody
[trust]
freshness_s = 50              # evaluations count up to this age
"""
STUDY = """\
# A study: all combinations of the values in [grid], each with `replicates` seeds.
[study]
name = "{name}"
question = "How old is the trust that vehicles use, by penetration and freshness window?"
replicates = 3

[base]                        # keys of the config that all runs share
traffic.scenario = "helsinki"
traffic.duration_s = 120

[grid]
fleet.penetration_p = [0.1, 0.35]
trust.freshness_s = [10, 50]

[keep]                        # what is measured of each run
topics = ["traffic", "encounters", "trust", "freshness"]
"""


def add_to(app: typer.Typer) -> None:
    """Add the command `init`."""
    app.command()(init)


def init(
    file: Annotated[
        Path | None, typer.Argument(help="File to write. The default is mine.toml, or study.toml with --study.")
    ] = None,
    study: Annotated[bool, typer.Option("--study", help="Write a study: several runs and one question.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write a config of 15 lines with comments, or a study, to change."""
    file = file or Path("study.toml" if study else "mine.toml")
    if file.suffix != ".toml":
        raise ValueError(f"{file}: configs and studies are TOML files. Give a name that ends in .toml.")
    try:
        with file.open("x", encoding="utf-8") as new:
            new.write(STUDY.format(name=file.stem) if study else CONFIG)
    except FileExistsError:
        raise ValueError(f"{file} is there already, and nothing was changed. Give another name.") from None
    except OSError as error:
        raise ValueError(f"{file} cannot be written: {error.strerror or error}. Give another name.") from None
    given = shlex.quote(str(file))
    then = f"cosim {'sweep' if study else 'run'} {given}"
    said = f"wrote {file}\ncheck it:  cosim check {given}\nrun it:    {then}"
    print_done({"wrote": str(file), "next": [f"cosim check {given}", then]}, said, as_json)
