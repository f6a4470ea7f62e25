"""The command that places roadside units."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.console import AsJson, TrustCode, print_json, print_note, progress, screen
from cosim.cli.help import Commands

place = Commands(help="Choose places for roadside units from traffic alone.")


@place.callback()
def _group() -> None:
    """Keeps `roadside` a command of its own, though it is the only one."""


@place.command()
def roadside(
    config: Annotated[
        Path | None, typer.Argument(help="Config file (TOML). Without one, the default city is used.")
    ] = None,
    count: Annotated[int, typer.Option(min=1, max=10_000, help="Number of units.")] = 5,
    height: Annotated[
        float, typer.Option(min=0.1, max=100, help="Height of the sensors above the street, in metres.")
    ] = 6.0,
    random: Annotated[
        bool, typer.Option("--random", help="Draw the junctions by the config's seed, for comparison.")
    ] = False,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="Change one key of the config, e.g. traffic.seed=7.")
    ] = None,
    trust_code: TrustCode = False,
    as_json: AsJson = False,
) -> None:
    """Choose junctions from which vehicles are seen as recently as possible, and print a section of a config."""
    from cosim.addons.law.placement import greedy, observe
    from cosim.cli.files import refuse_other_than_config
    from cosim.config.config import load
    from cosim.traffic.roadside import drawn
    from sumo_nets.network import Streets

    refuse_other_than_config(config)
    experiment = load(config, overrides, trust_code)
    with progress() as advance:
        sites, coverage = observe(experiment, height, advance)
    if count > len(sites):
        raise ValueError(f"--count {count}: the network has {len(sites)} junctions. Give a smaller number.")
    if random:
        by_name = {junction.name: c for c, junction in enumerate(sites)}
        in_order = drawn(Streets(sites, (0, 0, 0, 0)), experiment.seed)
        chosen = [by_name[junction.name] for junction in in_order[:count]]
    else:
        chosen = greedy(coverage, count)
    interval_s = experiment.sensing_interval_s
    rows = []
    for n in range(1, len(chosen) + 1):
        median, p90 = coverage.ages(chosen[:n], (0.5, 0.9))
        share = coverage.value(chosen[:n]) / (coverage.cap * coverage.weight.sum())
        site = sites[chosen[n - 1]]
        rows.append(
            {
                "n": n,
                "junction": site.name,
                "at": list(site.xyz_m[:2]),
                "objective": share,
                "median_s": interval_s * median,
                "p90_s": interval_s * p90,
            }
        )
    if as_json:
        print_json({"cap_s": interval_s * coverage.cap, "junctions": len(sites), "units": rows})
        return
    for row in rows:
        screen.print(
            f"# with the first {row['n']}: newest sight {row['median_s']:.3g} s old in the median, "
            f"{row['p90_s']:.3g} s in the 90th percentile, at most {interval_s * coverage.cap:g} s; "
            f"objective {row['objective']:.3f}",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
    listed = ", ".join(f'"{row["junction"]}"' for row in rows)
    section = f'[[roadside]]\njunctions = {len(rows)}\nchoose = "listed"\nlisted = [{listed}]\nheight_m = {height:g}\n'
    screen.print(section, soft_wrap=True, markup=False, highlight=False)
    how = "drawn" if random else "chosen greedily"
    where = "into the config"
    if experiment.roadside:
        where = "in place of [[roadside]] in the config: the units that it has do not count here"
    placed = f"{len(rows)} of {len(sites)} junctions, {how}"
    print_note(f"{placed}. Put the section {where}.")
