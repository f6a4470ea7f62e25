"""The command `check`: what a config or a study changes, and what follows from it."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli.console import (
    AsJson,
    ConfigPath,
    Overrides,
    Preset,
    TrustCode,
    duration,
    print_facts,
    print_json,
    print_line,
    print_note,
    with_preset,
)
from cosim.cli.files import is_study_file, refuse_other_than_config

if TYPE_CHECKING:
    from cosim.config.config import Config
    from cosim.studies.cost import Cost


def add_to(app: typer.Typer) -> None:
    """Add the command `check`."""
    app.command()(check)


def check(
    config: ConfigPath = None,
    overrides: Overrides = None,
    preset: Preset = None,
    everything: Annotated[bool, typer.Option("--all", help="Print the complete config, with all defaults.")] = False,
    trust_code: TrustCode = False,
    as_json: AsJson = False,
) -> None:
    """Check a config or a study. Print what it changes and what follows from it."""
    if config is not None and is_study_file(config):
        _check_study(config, preset, overrides or [], everything, trust_code, as_json)
        return
    refuse_other_than_config(config)
    from cosim.config.config import load
    from cosim.runs import check as checking
    from cosim.runs.manifest import toml_text
    from cosim.traffic.scene_summary import scene_summary

    experiment = load(config, with_preset(preset, overrides), trust_code)
    scenario = checking.check(experiment)
    for remark in checking.remarks_on(experiment, scenario, config) + checking.empty_streets(experiment, scenario):
        print_note(remark)
    loaded = scene_summary(scenario).lines
    if as_json:
        print_json(experiment.to_dict())
    elif everything:
        head = "".join(f"# {topic}: {line}\n" for topic, line in loaded.items())
        print_line(head + toml_text(experiment.to_dict()))
    else:
        _print_config(experiment, config, loaded, _words(config, preset, overrides))


def _words(config: Path | None, preset: str | None, overrides: list[str] | None) -> str:
    """Words of a command line that name this config."""
    words = [] if config is None else [str(config)]
    if preset is not None:
        words += ["--preset", preset]
    for override in overrides or []:
        words += ["--set", override]
    return "".join(f" {shlex.quote(word)}" for word in words)


def _print_config(experiment: "Config", path: Path | None, loaded: dict[str, str], words: str) -> None:
    from cosim.config.changes import changes
    from cosim.studies.cost import cost_of

    found = changes(experiment, path)
    what = f"the default of preset {experiment.preset}"
    n_keys = "1 key differs" if len(found) == 1 else f"{len(found)} keys differ"
    head = f"{n_keys} from {what}:" if found else f"no key differs from {what}"
    cost = cost_of(experiment)
    print_facts(
        {
            "config": [head, *(f"  {change.line}" for change in found)],
            **{topic: [line] for topic, line in loaded.items()},
            "vehicles": [_vehicles(cost)],
            **({"per second": [_per_second(cost)]} if experiment.sensing else {}),
            **costs(cost),
            "next": [f"cosim run{words}   cosim check{words} --all"],
        }
    )


def _vehicles(cost: "Cost") -> str:
    if not cost.n_vehicles:
        return "about 0 on the road: no departure of the demand is near the time that is recorded"
    said = f"about {cost.n_vehicles:,.0f} on the road"
    if cost.n_equipped:
        said += f", {cost.n_equipped:,.0f} of them with LiDAR and radio"
    return said


def _per_second(cost: "Cost") -> str:
    return (
        f"about {cost.sweeps_per_s:,.0f} sweeps of {cost.rays:,} rays, and up to {2 * cost.sweeps_per_s:,.0f} messages"
    )


def costs(cost: "Cost") -> dict[str, list[str]]:
    """Lines on time, memory and disk, with the cheapest change where the time is long."""
    lines = {
        "time": [f"about {duration(cost.wall_s)} ({cost.basis})"],
        "memory": [f"about {cost.memory_bytes / 1e9:.1f} GB; {cost.disk_bytes / 1e6:,.0f} MB on disk"],
    }
    if cost.cheaper:
        lines["time"].append(f"half of it: {cost.cheaper}")
    return lines


def _check_study(
    path: Path, preset: str | None, overrides: list[str], everything: bool, trust_code: bool, as_json: bool
) -> None:
    from cosim.runs import check as checking
    from cosim.studies.remarks import keys_in_vain, scene_notes
    from cosim.studies.study import changed, load
    from cosim.studies.sweep import unbegun

    study = changed(load(path, trust_code), with_preset(preset, overrides))
    task = unbegun(study, path.name)
    for config in {p.config.traffic: p.config for p in task.points}.values():
        checking.check(config)
    for note in keys_in_vain(task.points) + scene_notes(task.points):
        print_note(note)
    if everything:
        print_line(study.to_toml())
        return
    from cosim.cli.studies import plan_facts, plan_lines

    if as_json:
        print_json(plan_facts(task))
        return
    swept = []
    for key in study.keys:
        values = dict.fromkeys(str(point.keys[key]) for point in task.points)
        swept.append(f"{key}: {', '.join(values)}")
    words = _words(path, preset, overrides).strip()
    facts: dict[str, Any] = {
        "question": [study.head.question] if study.head.question else [],
        "swept": swept,
        "plan": plan_lines(task),
        "next": [f"cosim sweep {words}"],
    }
    print_facts({name: lines for name, lines in facts.items() if lines})
