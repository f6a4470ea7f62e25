"""Several attacks in one run: trust in the vehicles of each over time, under every trust model."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import trust
from results.run import Run
from results.study import said

_HONEST = "honest"


@style.styled
def draw(runs: Sequence[Run]) -> Figure:
    """Median trust, over pseudonyms, of each attack of the config and of honest vehicles; a panel per trust variant.

    Attacks are told apart by the keys in which their sections differ; the dashed line is the first attack.
    """
    variants, titles = style.variants_of(runs)
    columns = min(2, len(variants))
    height = 1.4 if len(variants) > 4 else 2.0
    figure, panels = style.sheet(len(variants), height, columns)
    names = labels(runs[0])
    if any(labels(run) != names for run in runs[1:]):
        raise ValueError("The runs have different attacks. Draw them one by one.")
    for i in style.draw_each(variants, lambda i, run: _panel(panels[i], run)):
        panels[i].text(0.5, 0.5, "no trust values", ha="center", va="center", transform=panels[i].transAxes)
    for i, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        is_last = i >= len(variants) - columns
        is_first = i % columns == 0
        style.panel(axes, title, style.TIME if is_last else "", "Trust (median)" if is_first else "")
        axes.tick_params(labelleft=is_first)
    entries = [style.entry(_HONEST, color=style.ROLE_INKS[_HONEST])]
    entries += [style.entry(name, **_look(i)) for i, name in names.items()]
    style.legend(figure, entries)
    return figure


def labels(run: Run) -> dict[int, str]:
    """What each section of `attacks` with vehicles of its own is called, by its position.

    It is the attack, the keys in which sections of this name differ, and what its vehicles do together with it.
    """
    sections: list[Mapping[str, Any]] = run.config.get("attacks", [])
    if not sections:
        raise ValueError(f"{run.path} has no [[attacks]]. Add a section, and run again.")
    found: dict[int, str] = {}
    for number, section in enumerate(sections):
        owner = number
        while (earlier := sections[owner].get("together_with")) is not None:
            owner = earlier
        if owner != number:
            found[owner] += f" with {section['attack']}"
            continue
        alike = [other for other in sections if other["attack"] == section["attack"]]
        words = [section["attack"]]
        for key, value in section.items():
            if key != "ids" and any(other.get(key) != value for other in alike):
                words.append(f"{key} {said(value)}")
        found[number] = ", ".join(words)
    names = list(found.values())
    for i, name in found.items():
        if names.count(name) > 1:
            found[i] = f"{i}: {name}"
    return found


def over_time(run: Run) -> pd.DataFrame:
    """Trust by attack: time_s, attack (position of the section, -1: honest), n (pseudonyms), median. Rated values."""
    frame = trust.values(run).query("rated")
    section = run.table("vehicles", ["vehicle", "attack"]).set_index("vehicle").attack
    frame = frame.assign(attack=frame.vehicle.map(section).fillna(-1).astype(int))
    found = frame.groupby(["time_s", "attack"]).trust.agg(n="size", median="median")
    return found.reset_index()


def _panel(axes: Axes, run: Run) -> None:
    found = over_time(run)
    if found.empty:
        raise run.lacks("trust values", "none rests on an evaluation by another vehicle. Run longer.")
    for attack in sorted(set(found.attack)):
        one = found[found.attack == attack]
        look = _look(attack) if attack >= 0 else {"color": style.ROLE_INKS[_HONEST]}
        marker = "o" if len(one) == 1 else ""
        axes.plot(one.time_s, one["median"], marker=marker, **look)
    starts = run.vehicles.attack_start_step.dropna()
    if len(starts):
        begin_s = float(starts.min()) * run.dt_s
        axes.axvline(begin_s, color="#444444", linewidth=0.8, linestyle=(0, (2, 2)))
    style.share_axis(axes)
    axes.set_xlim(left=0)


def _look(i: int) -> dict[str, Any]:
    inks = (*style.INKS[1:], style.INKS[0])
    return {"color": inks[i % len(inks)], "linestyle": style.dash(i)}
