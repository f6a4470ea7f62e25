"""The tables of the page of the benchmark, from the stored rows.

`python -m tests.verification.benchmark_page` writes them into the page, between `<!-- table -->` and `<!-- end -->`.
"""

from functools import cache
from pathlib import Path

from cosim.addons.benchmark.evidence import load
from cosim.addons.benchmark.table import Row, ranked, stored, summary, worst_attack

PAGE = Path("cosim/docs/pages/howto/benchmark.md")
BEGIN, END = "<!-- table -->\n", "<!-- end -->\n"
_MODELS = ("miso_v", "median_groups", "belief_graph", "prbi", "false_discovery", "trupercept", "beta")
SHOWN = (*_MODELS, "denied_share", "mean_score")


shipped = cache(load)
"""The set that ships, read once for all tests."""


def share(of: list[float | None], has_interval: bool = False) -> str:
    """Value, and its interval; "-" where there is none."""
    value, low, high = of
    if value is None:
        return "-"
    told = low is not None and high is not None and has_interval
    return f"{value:.2f} ({low:.2f} to {high:.2f})" if told else f"{value:.2f}"


def line(cells: list[str]) -> str:
    """A row of a table."""
    return f"| {' | '.join(cells)} |\n"


def of_model(row: Row) -> list[str]:
    """A model's cells in the first table."""
    of, worst, name = summary(row), row["worst_case"], worst_attack(row)
    return [
        f"`{row['model']}`", share(row["attacks"][name]["auc"], True), f"`{name}`", f"{of['auc_mean']:.2f}",
        f"{of['wrong_worst']:.2f}", f"{of['believed_mean']:.2f}", f"{of['age_mean_s']:.1f} s",
        *(("-", "-") if worst is None else (share(worst["harm"], True), share(worst["auc"]))),
    ]  # fmt: skip


def tables() -> str:
    """All that stands between the two marks."""
    evidence = shipped()
    rows, cases = ranked(stored(evidence)[0]), evidence.rules.cases[1:]
    adapted = [row for row in rows if row["worst_case"]]
    worst = adapted[0]["worst_case"]
    head = [
        "model", "worst AUC", "under", "mean AUC", "honest excluded, worst", "believed, mean", "age", "adapts: harm",
        "adapts: AUC",
    ]  # fmt: skip
    by_name = {row["model"]: row for row in rows}
    shown = [name for name in by_name if name in SHOWN]
    return "".join([
        f"Evidence set {evidence.version}, sha256 {evidence.checksum[:16]}. The adversary tried {worst['budget']} ",
        f"policies for {len(adapted)} of the models, each in {worst['n_worlds']} worlds.\n\n",
        line(head), "|---" * len(head) + "|\n", *(line(of_model(row)) for row in rows),
        "\nAUC under each attack, for some of them:\n\n",
        line(["attack", *(f"`{name}`" for name in shown)]), "|---" * (1 + len(shown)) + "|\n",
        *(line([f"`{a}`", *(share(by_name[name]["attacks"][a]["auc"]) for name in shown)]) for a in cases),
        "\nThe adversary's choice:\n\n",
        line(["model", "policy that harms it most"]), "|---|---|\n",
        *(line([f"`{row['model']}`", row["worst_case"]["words"]]) for row in adapted),
    ])  # fmt: skip


if __name__ == "__main__":
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    PAGE.write_text(before + BEGIN + tables() + END + rest.split(END, 1)[1], encoding="utf-8")
