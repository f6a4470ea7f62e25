"""What stands behind trust when it is looked up, and how old it is."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from results.figures import style
from results.metrics import freshness
from results.run import Run
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run]) -> Figure:
    """Age, at lookups, of the newest evaluation by another vehicle that could see, and what lookups rest on."""
    runs = style.arranged(runs)
    bars = [_shares(run, "all") for run in runs]
    labels = style.names(runs)
    if len(runs) == 1:
        roles = freshness.states(runs[0]).role.unique()
        bars, labels = [_shares(runs[0], role) for role in roles], list(roles)
    height = 0.8 + 0.2 * len(bars)
    figure, (ages, shares) = style.sheet(2, max(2.2, height))
    longest_s = 0.0
    for i, run in enumerate(runs):
        for what, dash in (("newest evaluation", style.dash(0)), ("value", style.dash(2))):
            try:
                curve = freshness.distribution(run, what)
            except ValueError:
                continue  # nothing but defaults
            ink = style.inks(runs)[i]
            line = ages.step(curve.age_s, curve.share, where="post", color=ink, linestyle=dash)
            if len(runs) == 1:
                line[0].set_label({"value": "the value itself"}.get(what, what))
            longest_s = max(longest_s, float(curve.age_s[curve.share >= 0.99].min()))
    if longest_s == 0:
        are_kept = any("trust_lookups" in run.tables for run in runs)
        why = "no value rests on an evaluation" if are_kept else "single lookups were not kept"
        ages.text(0.5, 0.5, why, ha="center", transform=ages.transAxes)
    elif len(runs) == 1:
        ages.legend(loc="lower right")
    for i, bar in enumerate(bars):
        style.shares_bar(shares, i, bar, _FILLS)
    title = "Age when looked up" if len(runs) == 1 else "Age (dotted: the value)"
    style.panel(ages, title, axis_label("trust_lookups", "age_s", "Age"), "Share at most this old")
    style.share_axis(ages)
    ages.set_xlim(0, max(longest_s, 1.0) * 1.05)
    style.panel(shares, "What stands behind lookups" + (", by role" if len(runs) == 1 else ""), "Share of lookups", "")
    style.bars_axis(shares, labels)
    entries = style.bar_entries(freshness.STATES, _FILLS)
    of_states = zip(entries, *bars, strict=True)
    there = [entry for entry, *found in of_states if any(found)]
    style.legend(figure, there, style.colour_entries(runs))
    return figure


_FILLS = (style.INKS[0], style.PALE, "#e8b9a6", "#ffffff")


def _shares(run: Run, role: str) -> list[float]:
    frame = freshness.states(run)
    share = frame[frame.role == role].set_index("state").share
    return [float(share.get(state, 0.0)) for state in freshness.STATES]
