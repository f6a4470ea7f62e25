"""Figures of a report that answer to the mouse: trust in every vehicle, with filters by role and attack.

The library Bokeh makes them. Its script is part of the page, so the page needs no server and no network.
"""

import re
from typing import Any

import numpy as np
import pandas as pd

from results.extras import needed
from results.figures import style
from results.metrics.trust import HONEST
from results.run import Run

MOST_POINTS = 40_000
"""Points that are drawn at most; of more, some vehicles of each role are left out."""

_SHOW = """
const wanted = new Set(roles.active.map(i => roles.labels[i]));
const attacking = new Set(attacks.active.map(i => attacks.labels[i]));
for (const [source, filter] of [[lines, of_lines], [points, of_points]]) {
    const {role, attack} = source.data;
    filter.booleans = Array.from(role, (name, i) => wanted.has(name) && attacking.has(attack[i]));
}
"""
"""Run in the page when a button is pressed: keep the rows of the chosen roles and attacks."""


def trust_values(run: Run) -> pd.DataFrame:
    """Trust of the measured variant in each pseudonym, for the figure.

    Returns
    -------
    time_s, trust, age_s (of the newest evaluation; NaN if there is none), n_evaluations, subject, vehicle, role, attack
    (its name in the config, with the number of its section, or `none`); sorted by subject and time.

    Raises
    ------
    ValueError
        In one line: the run has no trust values.
    """
    columns = ["step", "subject", "trust", "newest_evaluation_age_s", "n_evaluations"]
    rows = run.variant_table("trust", columns).sort_values(["subject", "step"])
    if rows.empty:
        raise ValueError(f"{run.path} has no trust values: its trust server never computed any.")
    attack_of = run.table("vehicles", ["vehicle", "attack"]).set_index("vehicle").attack
    names = [f"{i}: {attack.get('attack', '')}" for i, attack in enumerate(run.config.get("attacks") or ())]
    vehicle = rows.subject.map(run.subjects.vehicle).astype(np.int64)
    number = vehicle.map(attack_of)
    named = ["none" if pd.isna(n) else names[int(n)] if int(n) < len(names) else str(n) for n in number]
    return pd.DataFrame({
        "time_s": rows.step.to_numpy() * run.dt_s, "trust": rows.trust.to_numpy(float),
        "age_s": rows.newest_evaluation_age_s.to_numpy(float, na_value=np.nan),
        "n_evaluations": rows.n_evaluations.to_numpy(), "subject": rows.subject.to_numpy(),
        "vehicle": vehicle.to_numpy(),
        "role": vehicle.map(run.roles).astype(object).fillna(HONEST).to_numpy(), "attack": named,
    })  # fmt: skip


def thinned(rows: pd.DataFrame, most: int = MOST_POINTS) -> pd.DataFrame:
    """The rows of every k-th pseudonym of each role, so that there are about as many as wanted."""
    stride = -(-len(rows) // most)
    if stride <= 1:
        return rows
    subjects = rows.drop_duplicates("subject")
    kept = subjects[subjects.groupby("role").cumcount() % stride == 0].subject
    return rows[rows.subject.isin(kept)]


def scripts() -> str:
    """The library, as elements for the head of the page."""
    with needed("bokeh", "draws the figures with filters", "report"):
        from bokeh.resources import Resources
    return Resources(mode="inline", components=["bokeh", "bokeh-widgets"]).render()


def trust_figure(run: Run) -> str:
    """The figure as elements for the body of the page.

    Raises
    ------
    ValueError
        In one line: there is nothing to draw, or the library is not installed.
    """
    with needed("bokeh", "draws the figures with filters", "report"):
        from bokeh.embed import components
    whole = trust_values(run)
    rows = thinned(whole)
    script, element = components(_drawn(run, rows))
    left_out = whole.subject.nunique() - rows.subject.nunique()
    note = (
        f" {left_out} of {whole.subject.nunique()} pseudonyms are left out to keep the page small." if left_out else ""
    )
    text = (
        f"Trust in every pseudonym over time. Point at a value to read it; the buttons choose roles and attacks.{note}"
    )
    return _with_fixed_ids(f"<figure>{element}{script}<figcaption>{text}</figcaption></figure>")


def _with_fixed_ids(html: str) -> str:
    """The elements with numbers in place of random identifiers, so that a run has one report, byte by byte."""
    found = dict.fromkeys(re.findall(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}", html))
    number = {name: f"trust-{n}" for n, name in enumerate(found)}
    return re.sub("|".join(number), lambda name: number[name[0]], html) if number else html


def _drawn(run: Run, rows: pd.DataFrame) -> Any:
    from bokeh.layouts import column
    from bokeh.models import BooleanFilter, CDSView, CheckboxButtonGroup, ColumnDataSource, CustomJS, HoverTool
    from bokeh.plotting import figure

    inks = {role: style.role_look(role, run.role_labels)["color"] for role in run.role_labels}
    rows = rows.assign(ink=rows.role.map(inks))
    grouped = rows.groupby("subject", sort=True)
    lines = ColumnDataSource({
        "x": [g.time_s.tolist() for _, g in grouped], "y": [g.trust.round(4).tolist() for _, g in grouped],
        **{name: grouped[name].first().tolist() for name in ("role", "attack", "ink")},
    })  # fmt: skip
    shown = ("time_s", "trust", "age_s", "n_evaluations", "subject", "vehicle", "role", "attack", "ink")
    rows = rows.round({"trust": 4, "age_s": 2})
    points = ColumnDataSource({name: rows[name].tolist() for name in shown})
    of_lines, of_points = BooleanFilter([True] * grouped.ngroups), BooleanFilter([True] * len(rows))
    drawn = figure(
        height=380, sizing_mode="stretch_width", x_axis_label="Time [s]", y_axis_label="Trust", y_range=(-0.03, 1.03),
        tools="pan,wheel_zoom,box_zoom,reset,save", title="Trust in every vehicle",
    )  # fmt: skip
    drawn.multi_line("x", "y", source=lines, view=CDSView(filter=of_lines), color="ink", alpha=0.35, line_width=1.2)
    dots = drawn.scatter(
        "time_s", "trust", source=points, view=CDSView(filter=of_points), color="ink", size=5, alpha=0.7
    )
    tips = [
        ("vehicle", "@vehicle (pseudonym @subject)"), ("role", "@role, attack @attack"), ("time", "@time_s s"),
        ("trust", "@trust{0.000}"), ("newest evaluation", "@age_s{0.0} s old, of @n_evaluations"),
    ]  # fmt: skip
    drawn.add_tools(HoverTool(renderers=[dots], tooltips=tips))
    roles = [role for role in run.role_labels if (rows.role == role).any()]
    attacks = sorted(set(rows.attack), key=lambda name: (name != "none", name))
    by_role = CheckboxButtonGroup(labels=roles, active=list(range(len(roles))))
    by_attack = CheckboxButtonGroup(labels=attacks, active=list(range(len(attacks))))
    parts = {"roles": by_role, "attacks": by_attack, "lines": lines, "points": points}
    show = CustomJS(args=parts | {"of_lines": of_lines, "of_points": of_points}, code=_SHOW)
    by_role.js_on_change("active", show)
    by_attack.js_on_change("active", show)
    return column(by_role, by_attack, drawn, sizing_mode="stretch_width")
