"""The graph of contacts over time, and how far a message could spread along it."""

import heapq
from collections import defaultdict
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from results.metrics.encounters import DEFINITION
from results.run import Run

if TYPE_CHECKING:  # imported where it is used: measuring a run does without
    import networkx as nx


def definition(run: Run, radius_m: float | None = None, pairs: str | None = None) -> dict[str, float | str]:
    """One definition of an encounter, by column of `encounters.DEFINITION`.

    What is not given is chosen: the smallest radius, the first kind of pairs, and the first value of each further
    column.

    Raises
    ------
    ValueError
        If the run has no encounters, or none of the given radius or pairs.
    """
    frame = run.table("encounters", DEFINITION)
    if frame.empty:
        raise ValueError(f"{run.path} holds no encounters: no two came within the radius of each other.")
    found: dict[str, float | str] = {}
    for name, wanted in (
        ("radius_m", radius_m),
        ("pairs", pairs),
        ("hysteresis_s", None),
        ("los", None),
        ("pedestrians", None),
    ):
        there = sorted(frame[name].unique().tolist())
        chosen = there[0] if wanted is None else wanted
        if chosen not in there:
            raise ValueError(f"{run.path} recorded no encounters with {name} = {wanted}; it has {there}.")
        frame = frame[frame[name] == chosen]
        found[name] = chosen
    return found


def contacts(run: Run, radius_m: float | None = None, pairs: str | None = None) -> pd.DataFrame:
    """Intervals of contact by one definition of an encounter, see `definition`: a, b, start_s, end_s."""
    frame = run.table("encounters", ["a", "b", "start_step", "end_step", *DEFINITION])
    for name, chosen in definition(run, radius_m, pairs).items():
        frame = frame[frame[name] == chosen]
    return frame.assign(start_s=frame.start_step * run.dt_s, end_s=frame.end_step * run.dt_s)[
        ["a", "b", "start_s", "end_s"]
    ]


def graph(
    run: Run, start_s: float, end_s: float, radius_m: float | None = None, pairs: str | None = None
) -> "nx.Graph":
    """Actors that met in a time span; edges carry `contact_s`, the time they spent in contact in it."""
    frame = contacts(run, radius_m, pairs)
    frame = frame.assign(contact_s=frame.end_s.clip(upper=end_s) - frame.start_s.clip(lower=start_s))
    total = frame[frame.contact_s > 0].groupby(["a", "b"], as_index=False).contact_s.sum()
    import networkx as nx

    return nx.from_pandas_edgelist(total, "a", "b", "contact_s")


def over_time(run: Run, every_s: float = 10.0, radius_m: float | None = None, pairs: str | None = None) -> pd.DataFrame:
    """The graph of contacts at instants.

    Returns
    -------
    time_s, n_actors (with a contact), n_contacts, degree_mean, n_components, largest_share (of these actors
    in the largest component).
    """
    rows = []
    for time_s, n_contacts, actors, member in _instants(run, every_s, radius_m, pairs):
        n = len(actors)
        rows.append({
            "time_s": time_s, "n_actors": n, "n_contacts": n_contacts, "degree_mean": 2 * n_contacts / n if n else 0.0,
            "n_components": int(member.max()) + 1 if n else 0,
            "largest_share": np.bincount(member).max() / n if n else 0.0,
        })  # fmt: skip
    return pd.DataFrame(rows)


def temporal_reachability(
    run: Run, every_s: float = 10.0, radius_m: float | None = None, pairs: str | None = None, start_s: float = 0.0
) -> pd.DataFrame:
    """Temporal reachability of the contact graph: how far a message could spread, from many actors at once.

    Returns
    -------
    time_s; n_met: actors with a contact since `start_s`; reached_mean, reached_min: share of them that a message of one
    actor has reached, if every contact forwards it at once; over 64 sources, taken evenly from those in contact
    at the start.

    Notes
    -----
    Contacts are sampled every `every_s`: shorter ones may be missed, so this is a lower bound; `arrivals` is exact.
    """
    rows = []
    known = np.zeros(0, np.uint64)  # by actor, one bit per source
    met = np.zeros(0, bool)
    n_sources = 0
    for time_s, _, actors, member in _instants(run, every_s, radius_m, pairs):
        if time_s < start_s or not (len(actors) or n_sources):
            continue
        if len(actors) and actors[-1] >= len(known):
            more = int(actors[-1]) + 1 - len(known)
            known, met = np.append(known, np.zeros(more, np.uint64)), np.append(met, np.zeros(more, bool))
        if not n_sources:
            sources = actors[:: -(-len(actors) // 64)]
            n_sources = len(sources)
            known[sources] = np.uint64(1) << np.arange(n_sources, dtype=np.uint64)
        met[actors] = True
        together = np.zeros(int(member.max(initial=-1)) + 1, np.uint64)
        np.bitwise_or.at(together, member, known[actors])
        known[actors] = together[member]
        reached = [int(np.count_nonzero(known & (np.uint64(1) << np.uint64(i)))) for i in range(n_sources)]
        n_met = int(met.sum())
        rows.append({
            "time_s": time_s, "n_met": n_met, "reached_mean": float(np.mean(reached)) / n_met,
            "reached_min": min(reached) / n_met,
        })  # fmt: skip
    return pd.DataFrame(rows, columns=["time_s", "n_met", "reached_mean", "reached_min"])


def _instants(
    run: Run, every_s: float, radius_m: float | None, pairs: str | None
) -> Iterator[tuple[float, int, np.ndarray, np.ndarray]]:
    """At regular instants: time [s], contacts, actors with one, and the component that each belongs to."""
    frame = contacts(run, radius_m, pairs)
    start, end = (np.ceil(frame[name].to_numpy() / every_s).astype(np.int64) for name in ("start_s", "end_s"))
    n_instants = end - start  # at which each contact is sampled
    contact = np.repeat(np.arange(len(frame)), n_instants)
    instant = np.arange(len(contact)) - np.repeat(np.cumsum(n_instants) - n_instants - start, n_instants)
    order = np.argsort(instant, kind="stable")
    times = np.arange(int(np.ceil(run.manifest["steps"] * run.dt_s / every_s)))
    seen = np.split(contact[order], np.searchsorted(instant[order], times[1:]))
    who = frame[["a", "b"]].to_numpy()
    for time, now in zip(times, seen, strict=True):
        actors, index = np.unique(who[now], return_inverse=True)
        n, (a, b) = len(actors), index.reshape(-1, 2).T
        _, member = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)
        yield float(time * every_s), len(now), actors, member


def arrivals(
    run: Run, actor: int, start_s: float = 0.0, radius_m: float | None = None, pairs: str | None = None
) -> pd.DataFrame:
    """When a message of one actor could reach the others, if every contact forwards it at once: actor, time_s.

    The temporal reachability of the contact graph; only those it reaches have a row. See
    `message_reachability` for received messages, and `temporal_reachability` for many actors at once.
    """
    frame = contacts(run, radius_m, pairs)
    meets: dict[int, list[tuple[int, float, float]]] = defaultdict(list)
    for a, b, start, end in frame.itertuples(index=False):
        meets[a].append((b, start, end))
        meets[b].append((a, start, end))
    reached: dict[int, float] = {}
    queue = [(start_s, actor)]
    while queue:
        time_s, one = heapq.heappop(queue)
        if one in reached:
            continue
        reached[one] = time_s
        for other, start, end in meets[one]:
            if other not in reached and time_s < end:
                heapq.heappush(queue, (max(time_s, start), other))
    return pd.DataFrame({"actor": reached.keys(), "time_s": reached.values()})


def message_reachability(run: Run, vehicle: int, start_s: float = 0.0) -> pd.DataFrame:
    """When news of one vehicle reached the others by messages that were received: vehicle, time_s, n_messages.

    The temporal reachability of the relay graph. What is received in one step is forwarded from the next one on;
    `n_messages` is the length of the chain that came first.
    """
    time_s, length = {vehicle: start_s}, {vehicle: 0}
    for part in run.parts("receptions", ["step", "message_step", "sender", "receiver", "latency_s"]):
        part = part.assign(sender=part.sender.map(run.subjects.vehicle))
        for _, now in part[part.step * run.dt_s >= start_s].groupby("step"):
            now = now[now.sender.isin(list(time_s)) & ~now.receiver.isin(list(time_s))].sort_values("latency_s")
            now = now.drop_duplicates("receiver")
            time_s.update(zip(now.receiver, now.message_step * run.dt_s + now.latency_s, strict=True))
            length.update(zip(now.receiver, now.sender.map(length) + 1, strict=True))
    return pd.DataFrame({"vehicle": time_s.keys(), "time_s": time_s.values(), "n_messages": length.values()})
