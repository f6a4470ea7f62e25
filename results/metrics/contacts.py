"""Who can talk to whom: the graph of contacts over time, and what could spread along it."""

import heapq
from collections import defaultdict

import networkx as nx
import numpy as np
import pandas as pd
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from results.archive import Run


def contacts(run: Run, radius_m: float | None = None, pairs: str | None = None) -> pd.DataFrame:
    """Intervals of contact: a, b, start_s, end_s; of the smallest radius and the first kind of pairs, unless named."""
    frame = run.table("encounters", ["a", "b", "start_step", "end_step", "radius_m", "pairs"])
    if frame.empty:
        raise ValueError(f"{run.path} holds no encounters: nobody came within the radius of anybody.")
    for name, wanted in (("radius_m", radius_m), ("pairs", pairs)):
        there = sorted(frame[name].unique().tolist())
        chosen = there[0] if wanted is None else wanted
        if chosen not in there:
            raise ValueError(f"{run.path} recorded no encounters with {name} = {wanted}; it has {there}.")
        frame = frame[frame[name] == chosen]
    return frame.assign(start_s=frame.start_step * run.dt_s, end_s=frame.end_step * run.dt_s)[
        ["a", "b", "start_s", "end_s"]
    ]


def graph(run: Run, start_s: float, end_s: float, radius_m: float | None = None, pairs: str | None = None) -> nx.Graph:
    """Actors that met in a time span; edges carry `contact_s`, the time they spent in contact in it."""
    frame = contacts(run, radius_m, pairs)
    frame = frame.assign(contact_s=frame.end_s.clip(upper=end_s) - frame.start_s.clip(lower=start_s))
    total = frame[frame.contact_s > 0].groupby(["a", "b"], as_index=False).contact_s.sum()
    return nx.from_pandas_edgelist(total, "a", "b", "contact_s")


def over_time(run: Run, every_s: float = 10.0, radius_m: float | None = None, pairs: str | None = None) -> pd.DataFrame:
    """The graph of contacts at instants.

    Returns
    -------
    time_s, n_actors (with a contact), n_contacts, degree_mean, n_components, largest_share (of these actors
    in the largest component).
    """
    frame = contacts(run, radius_m, pairs)
    start, end = (np.ceil(frame[name].to_numpy() / every_s).astype(np.int64) for name in ("start_s", "end_s"))
    n_instants = end - start  # at which each contact is seen
    contact = np.repeat(np.arange(len(frame)), n_instants)
    instant = np.arange(len(contact)) - np.repeat(np.cumsum(n_instants) - n_instants - start, n_instants)
    order = np.argsort(instant, kind="stable")
    times = np.arange(int(np.ceil(run.manifest["steps"] * run.dt_s / every_s)))
    seen = np.split(contact[order], np.searchsorted(instant[order], times[1:]))
    who = frame[["a", "b"]].to_numpy()
    rows = []
    for time, now in zip(times, seen, strict=True):
        actors, index = np.unique(who[now], return_inverse=True)
        n, (a, b) = len(actors), index.reshape(-1, 2).T
        n_components, member = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)
        rows.append({
            "time_s": time * every_s, "n_actors": n, "n_contacts": len(now),
            "degree_mean": 2 * len(now) / n if n else 0.0, "n_components": n_components if n else 0,
            "largest_share": np.bincount(member).max() / n if n else 0.0,
        })  # fmt: skip
    return pd.DataFrame(rows)


def relays(run: Run) -> nx.DiGraph:
    """Who heard whom: edges from sender to receiver with `n` messages and mean `hops`, `latency_s`."""
    frame = run.table("deliveries", ["sender", "receiver", "hops", "latency_s"])
    edges = frame.groupby(["sender", "receiver"]).agg(
        n=("hops", "size"), hops=("hops", "mean"), latency_s=("latency_s", "mean")
    )
    return nx.from_pandas_edgelist(edges.reset_index(), "sender", "receiver", True, create_using=nx.DiGraph)


def arrivals(
    run: Run, actor: int, start_s: float = 0.0, radius_m: float | None = None, pairs: str | None = None
) -> pd.DataFrame:
    """When news of one actor could reach the others, if every contact passes it on at once: actor, time_s.

    The temporal reachability of the contact graph; only those it reaches have a row.
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
