"""What others have published about contacts of vehicles, and the same figure of a run beside it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd

from cosim.addons.durations.fit import Fit, fit, fits
from cosim.addons.durations.goodness import kolmogorov_smirnov, product_limit
from cosim.addons.durations.samples import Durations, What, definitions, of_run
from results.metrics.encounters import DEFINITION, Departure, named
from results.run import Run

Verdict = Literal["agrees", "differs", "not comparable"]

_LOS = ("los", "all_los")
_OPEN = 0.005
"""If the numbers of links with and without regard to sight differ by less than this share, nothing obstructs."""
_LEAST_EARLY = 0.125
"""Least share of durations within a quarter of the median, if the density falls: the distribution is then concave."""
_DECAYS = ("exponential", "generalised_pareto")


class Figure(NamedTuple):
    """A figure of a run beside a published one."""

    ours: str
    verdict: Verdict
    why: str
    """Why ours differs, or cannot be compared; what it rests on if it agrees."""


@dataclass(frozen=True, slots=True)
class ContactFact:
    """A published statement about contacts."""

    name: str
    says: str
    conditions: str
    source: str
    read: str
    """What of the source was read."""
    ours: Callable[["Contacts"], Figure]


@dataclass(frozen=True, slots=True)
class Contacts:
    """Encounters of a run, for comparison."""

    run: Run
    departure: Departure = "ends"

    def definition(self, has_los: bool = False, longest_hysteresis: bool = False) -> pd.Series | None:
        """The definition of largest radius, with or without line of sight; of these, that of least hysteresis."""
        found = definitions(self.run)
        found = found[found.pairs.isin(_LOS) == has_los]
        if found.empty:
            return None
        found = found.sort_values(["radius_m", "hysteresis_s"], ascending=[False, not longest_hysteresis])
        return found.iloc[0]

    def sample(self, what: What, definition: pd.Series) -> Durations:
        """Durations by a definition, read once."""
        name = f"{what} {tuple(definition[c] for c in DEFINITION)} {self.departure}"
        return self.run.once_for_all(name, lambda: of_run(self.run, what, definition, self.departure))

    def fits(self, what: What, definition: pd.Series) -> list[Fit]:
        """All families, the best first, fitted once."""
        name = f"fits to {what} {tuple(definition[c] for c in DEFINITION)} {self.departure}"
        return self.run.once_for_all(name, lambda: fits(self.sample(what, definition)))

    def fit(self, what: What, definition: pd.Series, family: str) -> Fit:
        """One of them."""
        return next(one for one in self.fits(what, definition) if one.name == family)

    def is_open(self, definition: pd.Series) -> bool:
        """Whether links with line of sight are as many as those without this condition, so that nothing obstructs."""
        rows = self.run.table("encounters", [*DEFINITION])
        alike = rows[(rows.radius_m == definition["radius_m"]) & (rows.hysteresis_s == definition["hysteresis_s"])]
        n = alike.pairs.value_counts()
        plain = {"los": "equipped", "all_los": "all"}[str(definition["pairs"])]
        return bool(n.get(plain, 0)) and abs(n[definition["pairs"]] / n[plain] - 1) < _OPEN

    @property
    def mean_time_on_road_s(self) -> float:
        """Mean time that an actor is on the road while recording."""
        vehicles = self.run.table("vehicles", ["first_step", "last_step"])
        return float((vehicles.last_step - vehicles.first_step + 1).mean() * self.run.dt_s)

    def mean_speed_mps(self) -> float:
        """Mean speed of moving and standing vehicles; NaN if the run has no table `actors`."""
        if "actors" not in self.run.tables:
            return float("nan")
        return float(self.run.table("actors", ["speed_mps"]).speed_mps.mean())


def label(definition: pd.Series) -> str:
    """A definition in words, with its hysteresis."""
    name = str(named(definition.to_frame().T).iloc[0])
    return f"{name}, hysteresis {definition['hysteresis_s']:g} s"


def _missing(what: str) -> Figure:
    return Figure("", "not comparable", f"the run counts no {what}. Add such a section to [[encounters]]")


def _too_few(error: ValueError) -> Figure:
    return Figure("", "not comparable", str(error).rstrip("."))


def ranked(found: list[Fit]) -> str:
    """Families in the order of AIC, with their differences to the best."""
    return ", ".join(
        f"{one.family.label}" + (f" (+{one.aic - found[0].aic:,.0f})" if i else "") for i, one in enumerate(found)
    )


def _link_is_pareto(contacts: Contacts) -> Figure:
    definition = contacts.definition()
    if definition is None:
        return _missing("pairs without regard to line of sight")
    sample = contacts.sample("duration", definition)
    try:
        found = contacts.fits("duration", definition)
    except ValueError as error:
        return _too_few(error)
    rank = [one.name for one in found].index("generalised_pareto")
    pareto = found[rank]
    shape, low, high = pareto.parameters()["shape"]
    distance, best = (kolmogorov_smirnov(sample, one).value for one in (pareto, found[0]))
    ours = (
        f"{label(definition)}: by AIC {ranked(found)}; generalised Pareto has rank {rank + 1} of {len(found)}, shape "
        f"{shape:.2f} ({low:.2f} to {high:.2f}), distance {distance:.3f} (best {best:.3f})"
    )
    if rank == 0:
        return Figure(ours, "agrees", "the family of the source has the lowest AIC")
    curve = product_limit(sample)
    early = 1 - _left(curve, _median_s(curve) / 4)
    if early < _LEAST_EARLY:
        why = (
            f"{early:.1%} of links end within a quarter of the median, and a density that falls from the beginning, as "
            f"that of the generalised Pareto, has at least {_LEAST_EARLY:.1%} there: crossing the radius takes its "
            "time. Positions at long intervals would hide that; the abstract does not say how far apart its are"
        )
    else:
        why = (
            "the difference lies in the tail: cars that stand or drive together form a second kind of links. The "
            "abstract does not say which families were compared"
        )
    return Figure(ours, "differs", why)


def _median_s(curve: pd.DataFrame) -> float:
    """First duration at which half or less is left; NaN if the curve stays above."""
    return float(curve.duration_s[curve.survival <= 0.5].min())


def _left(curve: pd.DataFrame, x_s: float) -> float:
    """Share that lasts longer than `x_s`; NaN for NaN."""
    at = int(np.searchsorted(curve.duration_s.to_numpy(), x_s, "right"))
    return float("nan") if np.isnan(x_s) else 1.0 if at == 0 else float(curve.survival.to_numpy()[at - 1])


def _beyond(sample: Durations, from_s: float) -> Durations:
    """Durations longer than `from_s`, of which shorter ones are not in the sample."""
    keep = sample.low_s >= from_s - 1e-9
    cut = sample.take(keep)
    return replace(cut, entry_s=np.minimum(np.maximum(cut.entry_s, from_s), cut.low_s))


def _up_to(sample: Durations, until_s: float) -> Durations:
    """Durations watched no longer than `until_s`."""
    beyond = sample.high_s > until_s + 1e-9
    return replace(
        sample, low_s=np.where(beyond, np.minimum(sample.low_s, until_s), sample.low_s),
        high_s=np.where(beyond, np.inf, sample.high_s),
    )  # fmt: skip


def _split_s(sample: Durations) -> float:
    """Median of the durations whose end was observed, at the edge of a step."""
    low = np.sort(sample.low_s[sample.ended])
    return float(low[len(low) // 2]) if len(low) else float("nan")


def _horizon(contacts: Contacts, sample: Durations) -> str:
    seen = float(sample.high_s[sample.ended].max()) if sample.ended.any() else 0.0
    return (
        f"An actor is on the road for {contacts.mean_time_on_road_s:.0f} s on average, {1 - sample.ended.mean():.0%} "
        f"of pairs are not seen to meet again, and the longest time observed is {seen:.0f} s"
    )


def _tail_is_exponential(contacts: Contacts) -> Figure:
    definition = contacts.definition()
    if definition is None:
        return _missing("pairs without regard to line of sight")
    sample = contacts.sample("inter_contact", definition)
    split_s = _split_s(sample)
    try:
        tail = _beyond(sample, split_s)
        shape, low, high = fit(tail, "generalised_pareto").parameters()["shape"]
        exponential = fit(tail, "exponential").parameters()["mean_s"][0]
    except ValueError as error:
        return _too_few(error)
    ours = (
        f"{label(definition)}: beyond the median of {split_s:.0f} s, generalised Pareto shape {shape:.2f} ({low:.2f} "
        f"to {high:.2f}); 0 is exponential, here with a mean of {exponential:.0f} s"
    )
    if np.isnan(low):
        return Figure(
            ours, "not comparable", f"too little is observed to bound the shape. {_horizon(contacts, sample)}"
        )
    if low <= 0 <= high:
        return Figure(ours, "agrees", f"the interval contains 0. {_horizon(contacts, sample)}")
    heavier = "heavier" if shape > 0 else "lighter"
    why = (
        f"the tail is {heavier} than exponential over what is observed. {_horizon(contacts, sample)}. Vehicles here "
        "leave after one trip, and who meets again within it mostly has the same route or queue. The taxis of the "
        "source stay in the city, and meet again from other places"
    )
    why += _never_again(shape)
    return Figure(ours, "differs", why)


def _exponential_then_log_normal(contacts: Contacts) -> Figure:
    definition = contacts.definition()
    if definition is None:
        return _missing("pairs without regard to line of sight")
    sample = contacts.sample("inter_contact", definition)
    split_s = _split_s(sample)
    try:
        gains = [
            fit(part, "exponential").aic - fit(part, "log_normal").aic
            for part in (_up_to(sample, split_s), _beyond(sample, split_s))
        ]
    except ValueError as error:
        return _too_few(error)
    better = ["log-normal" if gain > 0 else "exponential" for gain in gains]
    ours = (
        f"{label(definition)}: up to {split_s:.0f} s {better[0]} (AIC better by {abs(gains[0]):,.0f}), beyond "
        f"{better[1]} (by {abs(gains[1]):,.0f})"
    )
    if better == ["exponential", "log-normal"]:
        return Figure(ours, "agrees", "the abstract gives no place of the split; ours is the median of observed times")
    why = (
        "the abstract gives no place of the split; ours is the median of observed times. Vehicles here leave after one "
        f"trip. {_horizon(contacts, sample)}"
    )
    return Figure(ours, "differs", why)


def _never_again(shape: float) -> str:
    """What a shape without a mean says; empty for one with a mean."""
    return ". A shape above 1 has no mean: it stands for pairs that never meet again" if shape > 1 else ""


_HALF_DAY_S = 12 * 3600.0


def _power_law_to_half_a_day(contacts: Contacts) -> Figure:
    definition = contacts.definition()
    if definition is None:
        return _missing("pairs without regard to line of sight")
    sample = contacts.sample("inter_contact", definition)
    try:
        exponential, pareto = (contacts.fit("inter_contact", definition, name) for name in _DECAYS)
    except ValueError as error:
        return _too_few(error)
    seen_s = float(sample.high_s[sample.ended].max())
    shape, low, high = pareto.parameters()["shape"]
    gain = exponential.aic - pareto.aic
    ours = (
        f"{label(definition)}: generalised Pareto beats exponential by {gain:,.0f} in AIC, shape {shape:.2f} "
        f"({low:.2f} to {high:.2f}; above 0 is a power law); observed up to {seen_s:.0f} s"
    )
    if seen_s >= _HALF_DAY_S:
        agrees = gain > 0 and low > 0
        return Figure(ours, "agrees" if agrees else "differs", "observed beyond half a day")
    head = "falls like a power law, as in the source" if gain > 0 and low > 0 else "does not fall like a power law"
    why = (
        f"only the first {seen_s:.0f} s are seen, and there it {head}. What comes after half a day is not seen"
        f"{_never_again(shape)}"
    )
    return Figure(ours, "not comparable", why)


def _buses_power_law(contacts: Contacts) -> Figure:
    definition = contacts.definition()
    if definition is None:
        return _missing("pairs without regard to line of sight")
    sample = contacts.sample("inter_contact", definition)
    vehicles = contacts.run.table("vehicles", ["vehicle", "vehicle_class"])
    buses = vehicles.vehicle[vehicles.vehicle_class == "bus"].to_numpy()
    keep = np.isin(sample.a, buses) & np.isin(sample.b, buses)
    of_buses = sample.take(keep)
    try:
        exponential, pareto = (fit(of_buses, name) for name in _DECAYS)
    except ValueError as error:
        return Figure("", "not comparable", f"of {len(buses)} buses on the road: {str(error).rstrip('.')}")
    shape, low, high = pareto.parameters()["shape"]
    gain = exponential.aic - pareto.aic
    ours = (
        f"{label(definition)}, two buses: generalised Pareto beats exponential by {gain:,.0f} in AIC, shape "
        f"{shape:.2f} ({low:.2f} to {high:.2f}; above 0 is a power law)"
    )
    agrees = gain > 0 and low > 0
    return Figure(ours, "agrees" if agrees else "differs", _horizon(contacts, of_buses))


def _freeway_median(contacts: Contacts) -> Figure:
    definition = contacts.definition()
    if definition is None:
        return _missing("pairs without regard to line of sight")
    curve = product_limit(contacts.sample("duration", definition))
    median_s = _median_s(curve)
    if np.isnan(median_s):
        return Figure("", "not comparable", "more than half of the links outlast what was observed")
    speed = contacts.mean_speed_mps()
    between = _left(curve, 15.0) - _left(curve, 30.0)
    ours = f"{label(definition)}: median {median_s:.0f} s, {between:.0%} between 15 and 30 s"
    ours += "" if np.isnan(speed) else f"; mean speed {speed:.1f} m/s"
    if not speed >= 15.0:
        drive = "unknown speed" if np.isnan(speed) else f"{speed:.1f} m/s on average"
        return Figure(ours, "not comparable", f"the source drove on a freeway; vehicles here drive at {drive}")
    if 15.0 <= median_s <= 30.0:
        return Figure(ours, "agrees", "the median lies in the range of most links of the source")
    why = (
        f"the source's links began at 133 m and ended at 500 m on average, by radio; here a link begins and ends at "
        f"{definition['radius_m']:g} m"
    )
    return Figure(ours, "differs", why)


def _los_power_law(contacts: Contacts) -> Figure:
    definition = contacts.definition(has_los=True)
    if definition is None:
        return _missing('pairs with line of sight (pairs = "los" or "all_los")')
    if contacts.is_open(definition):
        return Figure("", "not comparable", "nothing obstructs here: the city of the run has no buildings, or few")
    sample = contacts.sample("duration", definition)
    split_s = _split_s(sample)
    try:
        tail = _beyond(sample, split_s)
        exponential, pareto = (fit(tail, name) for name in _DECAYS)
    except ValueError as error:
        return _too_few(error)
    shape, low, high = pareto.parameters()["shape"]
    gain = exponential.aic - pareto.aic
    ours = (
        f"{label(definition)}: beyond the median of {split_s:.0f} s, generalised Pareto beats exponential by "
        f"{gain:,.0f} in AIC, shape {shape:.2f} ({low:.2f} to {high:.2f}; above 0 is a power law)"
    )
    if gain > 0 and low > 0:
        return Figure(ours, "agrees", "the tail beyond the median is that of a power law")
    return Figure(ours, "differs", "links end where the radius ends, which cuts the longest")


FACTS: tuple[ContactFact, ...] = (
    ContactFact(
        "link duration, taxis",
        "link duration is generalised Pareto",
        "taxis of one metropolis of China, several communication distances, maximum likelihood",
        "Empirical study on taxi's mobility nature in dense urban area, IEEE INFOCOM Workshops 2018, pp. 232-237",
        "abstract",
        _link_is_pareto,
    ),
    ContactFact(
        "connection duration, freeway",
        "most connections last 15 to 30 s, median 23 s; mean distance 133 m when they begin, 500 m when they end",
        "10 cars with WiFi in loops on 5 miles of a freeway; most connections between opposite directions",
        "Seada, Insights from a freeway car-to-car real-world experiment, ACM WiNTECH 2008",
        "abstract",
        _freeway_median,
    ),
    ContactFact(
        "duration of line of sight",
        "durations with line of sight follow a power law",
        "802.11p units in an urban environment, empirical measurements",
        "Lv et al., An empirical study on urban IEEE 802.11p vehicle-to-vehicle communication, IEEE SECON 2016",
        "abstract",
        _los_power_law,
    ),
    ContactFact(
        "inter-contact time, taxis",
        "the tail is exponential over a large range of time scales",
        "thousands of taxis in Shanghai",
        "Zhu et al., Impact of traffic influxes, IEEE TPDS 22(8), 2011, pp. 1258-1266",
        "abstract",
        _tail_is_exponential,
    ),
    ContactFact(
        "inter-contact time, taxis in parts",
        "exponential when short, log-normal when long",
        "taxis in Beijing, interpolated traces",
        "Hu et al., Modeling the statistical distribution of the inter-contact times, J. BUPT 42(3), 2019, pp. 91-97",
        "abstract",
        _exponential_then_log_normal,
    ),
    ContactFact(
        "inter-contact time, buses",
        "inter-contact durations follow a power law",
        "about 1,200 vehicles of a public transport network",
        "Ahmed, Kanhere, On the characterisation of vehicular mobility in a large-scale public transport network, "
        "IJAHUC 11(2/3), 2012, pp. 68-81",
        "abstract",
        _buses_power_law,
    ),
    ContactFact(
        "inter-contact time, people",
        "power law up to about half a day, exponential beyond",
        "mobile devices in a diverse set of measured traces",
        "Karagiannis, Le Boudec, Vojnovic, Power law and exponential decay of inter contact times, ACM MobiCom 2007",
        "abstract",
        _power_law_to_half_a_day,
    ),
)  # fmt: skip
"""Published statements, with the figure of a run that stands beside each."""

_IN_WORDS = {
    "exponential": "the chance to end is the same at any age",
    "log_normal": "most take a typical time, and a few take many times as long",
    "hyper_exponential": "there are two kinds, a short and a long one, such as passing and driving together",
}


def judge(run: Run, departure: Departure = "ends") -> pd.DataFrame:
    """Every published fact beside the figure of a run.

    Returns
    -------
    fact, published, conditions, source, read (what of the source was read), ours, verdict, why.
    """
    contacts = Contacts(run, departure)
    rows = []
    for fact in FACTS:
        figure = fact.ours(contacts)
        rows.append({
            "fact": fact.name, "published": fact.says, "conditions": fact.conditions, "source": fact.source,
            "read": fact.read, "ours": figure.ours, "verdict": figure.verdict, "why": figure.why,
        })  # fmt: skip
    return pd.DataFrame(rows)


def sentences(run: Run, departure: Departure = "ends") -> pd.DataFrame:
    """The families by AIC for each definition of a run, for durations and inter-contact times, with a sentence.

    Returns
    -------
    The columns of `DEFINITION`, what, n, n_ended, ranking, ks (distance of the best), sentence.
    """
    rows = []
    contacts = Contacts(run, departure)
    names: dict[What, str] = {"duration": "durations", "inter_contact": "times between encounters"}
    for _, definition in definitions(run).iterrows():
        for what, name in names.items():
            sample = contacts.sample(what, definition)
            row = {column: definition[column] for column in DEFINITION} | {
                "what": what, "n": len(sample), "n_ended": int(sample.ended.sum()),
            }  # fmt: skip
            try:
                found = contacts.fits(what, definition)
            except ValueError as error:
                rows.append(row | {"ranking": "", "ks": float("nan"), "sentence": str(error)})
                continue
            best, distance = found[0], kolmogorov_smirnov(sample, found[0]).value
            sentence = (
                f"{name.capitalize()} ({label(definition)}) are closest to {best.family.label}: {_meaning(best)}. Its "
                f"curve is at most {100 * distance:.1f} points off; the next family, {found[1].family.label}, is "
                f"{found[1].aic - best.aic:,.0f} worse in AIC."
            )
            rows.append(row | {"ranking": ranked(found), "ks": distance, "sentence": sentence})
    return pd.DataFrame(rows)


def _meaning(best: Fit) -> str:
    if best.name in _IN_WORDS:
        return _IN_WORDS[best.name]
    shape = best.parameters()["shape"][0]
    ages = shape > 1 if best.name == "weibull" else shape < 0
    return f"the longer one has lasted, the {'more' if ages else 'less'} likely it ends (shape {shape:.2f})"
