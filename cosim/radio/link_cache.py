"""Links and neighbours of the stations of a round, and the noise of jammers among them."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.base import rng
from cosim.base.ragged import offsets, owner_of_rows, ranges
from cosim.base.threads import beside
from cosim.radio.channel import JammedStations, Links
from cosim.radio.link_budget import from_db, links_between, los_pairs
from cosim.radio.message_round import Stations
from cosim.radio.params import RadioParams
from cosim.radio.receptions import NeighbourList, slant_m
from sensors.line_of_sight import LosOfPlaces


@dataclass(frozen=True, slots=True)
class LinkCache:
    """Links and neighbours of the stations of the last round; both rounds of a step have the same positions."""

    stations: Stations
    links: Links
    neighbours: NeighbourList
    sends: Bool[ndarray, "n"]
    """Stations that may send. Their links and neighbours are complete; those of others are not computed."""

    @staticmethod
    def of(
        stations: Stations,
        params: RadioParams,
        seed: int,
        los: LosOfPlaces | None,
        sends: Bool[ndarray, "n"] | None = None,
    ) -> "LinkCache":
        """Compute the links and neighbours of these stations, from those that send; None: from all."""
        xyz_m, propagation = stations.xyz_m, params.propagation
        knows_walls = los is not None and propagation.knows_walls
        sends = np.ones(len(stations), bool) if sends is None else sends
        found = los_pairs(xyz_m, propagation, los, slant_m(xyz_m, params.range_m), sends)
        near = beside(partial(NeighbourList.of, xyz_m, params.range_m, found, knows_walls))
        links = links_between(
            xyz_m,
            stations.key,
            propagation,
            rng.key(seed, rng.Stream.SHADOWING),
            los,
            found=found,
            above_street_m=stations.above_street_m,
            bodies=stations.bodies,
            sends=sends,
        )
        bodies = stations.bodies if propagation.blockage == "bodies" else None
        kept = replace(
            stations, abuse=None, key=stations.key.copy(), xyz_m=xyz_m.copy(),
            bodies=None if bodies is None else bodies.copy(),
        )  # fmt: skip  # the caller may go on to move its own
        return LinkCache(kept, links, near(), sends)

    def and_also(self, other: "LinkCache") -> "LinkCache":
        """The links and neighbours of the same stations, of the stations that send here or there."""
        links, near = self.links, self.neighbours
        ptr, at = _joined(links.ptr, other.links.ptr, other.sends)
        near_ptr, near_at = _joined(near.ptr, other.neighbours.ptr, other.sends)

        def both(mine: ndarray, theirs: ndarray, at: Int[ndarray, "k"]) -> ndarray:
            return np.concatenate([mine, theirs])[at]

        of_both = zip(near[1:], other.neighbours[1:], strict=True)
        columns = (both(mine, theirs, near_at) for mine, theirs in of_both)
        return replace(
            self,
            links=Links(
                key=links.key,
                ptr=ptr,
                receiver=both(links.receiver, other.links.receiver, at),
                power_mw=both(links.power_mw, other.links.power_mw, at),
                fading=both(links.fading, other.links.fading, at),
            ),
            neighbours=NeighbourList(near_ptr, *columns),
            sends=self.sends | other.sends,
        )

    def serves(self, stations: Stations) -> bool:
        """Whether these are the links of these stations."""
        bodies = self.stations.bodies
        return self.stations.equals(stations) and (bodies is None or bodies.equals(stations.bodies))


def _joined(
    ptr: Int[ndarray, "n+1"], other: Int[ndarray, "n+1"], of_other: Bool[ndarray, "n"]
) -> tuple[Int[ndarray, "n+1"], Int[ndarray, "k"]]:
    """Compressed rows of which some are those of another list: where they begin, and places in both lists together."""
    size = np.where(of_other, np.diff(other), np.diff(ptr))
    begin_of_other = ptr[-1] + other[:-1]
    begin = np.where(of_other, begin_of_other, ptr[:-1])
    return offsets(size), ranges(begin, size)


def jammed(links: Links, stations: Stations, params: RadioParams) -> Links:
    """The links with the noise of jammers among the stations.

    Notes
    -----
    A jammer's noise arrives with the mean power of a frame that is sent with the jammer's power. It reaches only
    receivers with a link above the cut-off, and it does not fade. Carrier sense and the channel busy ratio do not
    notice it. A reactive jammer detects frames that arrive with `detectable_dbm` or more on average. It reacts in
    time for the payload but not for the preamble. If several jammers react, each frame that one of them detects
    suffers the noise of all of them.
    """
    abuse = stations.abuse
    if abuse is None:
        return links
    if not np.isfinite([abuse.jam_dbm, abuse.react_dbm]).any():
        return links
    sender = owner_of_rows(np.diff(links.ptr))
    noise = []
    for dbm in (abuse.jam_dbm, abuse.react_dbm):
        times_frame = from_db(dbm - params.propagation.tx_power_dbm)
        noise_mw = links.power_mw * times_frame[sender]
        noise.append(np.bincount(links.receiver, noise_mw, len(stations)))
    detects = np.isfinite(abuse.react_dbm)[links.receiver]
    detects &= links.power_mw >= from_db(params.receiver.detectable_dbm)
    detected = np.bincount(sender, detects, len(stations)) > 0
    return replace(links, jamming=JammedStations(noise[0], noise[1], detected))
