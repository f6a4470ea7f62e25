"""Rounds of messages over one shared channel: packets, relays by contention, congestion control.

A message longer than a frame is cut into segments; each is lost, relayed and received on its own, and the message
is there when all of them are.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.v2x import channel, dcc
from cosim.v2x.accounts import Aired, Near, Tries, deliveries, slant_m
from cosim.v2x.channel import Access, AccessParams, Outcome, Packets
from cosim.v2x.dcc import Control, DccParams
from cosim.v2x.exchange import Frames, Heard, RelayParams
from cosim.v2x.links import between, look
from cosim.v2x.messages import segments
from cosim.v2x.obstruction import Sight
from cosim.v2x.propagation import PropagationParams
from cosim.v2x.reception import MAC_OVERHEAD_BYTES, ReceiverParams, airtime_ns
from cosim.v2x.relays import UNIT, Relays, Rules, own_frames


@dataclass(frozen=True, slots=True)
class Ground:
    """Radios at their places, and what lies between them."""

    xyz_m: Float[ndarray, "n 3"]
    key: UInt64[ndarray, "n"]
    asked: tuple[PropagationParams, float]
    """Propagation and reach."""
    links: channel.Links
    near: Near

    def serves(self, xyz_m: ndarray, key: ndarray, asked: tuple[PropagationParams, float]) -> bool:
        """Whether these are the same radios at the same places, and the same is asked of them."""
        return self.asked == asked and np.array_equal(self.key, key) and np.array_equal(self.xyz_m, xyz_m)


@dataclass(slots=True)
class Air:
    """What the channel remembers from one round to the next."""

    sight: Sight | None
    """Lines of sight between the city's walls; None without buildings."""
    seed: int
    state: channel.State
    control: Control
    n_frames: int = 0
    """Frames handed to the channel so far: the number of the next one."""
    ground: Ground | None = None
    """Of the last round: both rounds of a turn find everybody at the same place."""

    @staticmethod
    def start(sight: Sight | None, seed: int) -> "Air":
        return Air(sight, seed, channel.State.start(), Control.start())

    def over(self, xyz_m: ndarray, key: ndarray, propagation: PropagationParams, reach_m: float) -> Ground:
        """The ground of a round; what was found is kept for the next one."""
        asked = propagation, reach_m
        if self.ground is None or not self.ground.serves(xyz_m, key, asked):
            knows_walls = self.sight is not None and propagation.knows_walls
            seen = look(xyz_m, propagation, self.sight, slant_m(xyz_m, reach_m))
            near = Near.of(xyz_m, reach_m, seen, knows_walls)
            shadows = rng.key(self.seed, rng.Stream.SHADOWING)
            links, _, _ = between(xyz_m, key, propagation, shadows, self.sight, seen=seen)
            self.ground = Ground(xyz_m.copy(), key.copy(), asked, links, near)
        return self.ground


def broadcast(
    air: Air,
    xyz_m: Float[ndarray, "n 3"],
    name_key: UInt64[ndarray, "n"],
    talks: Bool[ndarray, "n"],
    length_bytes: Int[ndarray, "n"],
    round_number: int,
    begin_s: float,
    timeout_s: float,
    reach_m: float,
    propagation: PropagationParams,
    receiver: ReceiverParams,
    access: AccessParams,
    congestion: DccParams,
    relay: RelayParams,
) -> tuple[Heard, Frames]:
    """One message from every radio that talks, generated at a random time in the first half of the round.

    Parameters
    ----------
    xyz_m
        Antennas.
    round_number
        Counts the rounds of the run: with the sender it names a message.
    reach_m
        Frames from farther away interfere, but are nobody's message.
    """
    n = len(xyz_m)
    begin_ns, end_ns = round(begin_s * 1e9), round((begin_s + timeout_s) * 1e9)
    lifetime_ns = round(access.lifetime_s * 1e9)
    chance = rng.key(air.seed, rng.Stream.CHANNEL)
    ground = air.over(xyz_m, name_key, propagation, reach_m)

    phase = rng.uniforms(rng.key(air.seed, rng.Stream.GENERATION, round_number), name_key)[:, 0]
    units, n_segments = _units(talks, length_bytes, name_key, round_number, receiver.rate_mbps)
    author = units["author"]
    own_ns = begin_ns + np.floor(phase[author] * (end_ns - begin_ns) / 2).astype(np.int64)
    first_tag = air.n_frames
    relays = None
    if relay.max_hops > 1:
        rules = Rules(
            max_hops=relay.max_hops, contends=relay.rule == "contention",
            forward_p=relay.forward_p, hear_m=reach_m, pass_m=relay.reach_m, timer_min_s=relay.timer_min_s,
            timer_max_s=relay.timer_max_s, timer_distance_m=relay.timer_distance_m, end_ns=end_ns,
            lifetime_ns=lifetime_ns, access=int(Access.BE), first_tag=first_tag,
            chance=rng.key(air.seed, rng.Stream.RELAY, round_number),
        )  # fmt: skip
        relays = Relays.of(rules, units, name_key, xyz_m[:, :2])

    period_ns = round(congestion.period_s * 1e9)
    waits = np.ones(len(units), bool)
    outcomes: list[Outcome] = []
    busy = np.zeros(n)
    measured, strong = 0, np.zeros(n)  # since congestion control last looked
    if air.state.now_ns < begin_ns:
        _idle(air, ground.links, begin_ns, chance, receiver, access, congestion)
    while air.state.now_ns < end_ns:
        start_ns = stop_ns = air.state.now_ns
        if not len(air.state.packets):  # silence until somebody has something to say
            timer_ns = end_ns if relays is None else relays.next_ns
            stop_ns = min(int(own_ns[waits].min(initial=end_ns)), timer_ns, end_ns - period_ns)
        stop_ns = min(max(start_ns, stop_ns) + period_ns, end_ns)
        due = np.flatnonzero(waits & (own_ns < stop_ns))
        waits[due] = False
        packets = Packets(
            sender=author[due], seq=units["seq"][due], generated_ns=own_ns[due],
            payload_bytes=units["payload_bytes"][due], access=np.full(len(due), Access.BE, np.uint8),
            lifetime_ns=np.minimum(lifetime_ns, end_ns - own_ns[due]), tag=first_tag + due,
        )  # fmt: skip
        gap_ns = dcc.gap_ns(air.control, name_key, congestion)
        air.state, out = channel.play(
            air.state, ground.links, packets, stop_ns, chance, receiver, access, gap_ns, relays
        )
        outcomes.append(out)
        span = stop_ns - start_ns
        busy += out.busy * span
        strong, measured = strong + out.busy_strong * span, measured + span
        while measured >= congestion.period_s * 1e9 - 1:
            air.control = dcc.react(air.control, name_key, np.minimum(strong / measured, 1.0), congestion)
            strong *= max(0.0, 1 - congestion.period_s * 1e9 / measured)
            measured -= period_ns

    frames = own_frames(units) if relays is None else relays.frames
    air.n_frames += len(frames)
    aired = Aired.of(frames, units, outcomes, first_tag)
    tries = Tries.of(aired, ground.near)
    heard, n_duplicate = deliveries(aired, tries, own_ns, n_segments, begin_ns, xyz_m[:, :2])
    on_air = aired.on_air
    return heard, Frames(
        tries.author, tries.receiver, tries.hop, tries.distance_m, tries.view, tries.fate,
        np.bincount(aired.author[on_air], minlength=n), int((aired.hop[on_air] > 1).sum()), n_duplicate,
        float(np.sum(units["payload_bytes"][aired.unit[on_air]] + MAC_OVERHEAD_BYTES)), busy / (end_ns - begin_ns),
    )  # fmt: skip


def _units(
    talks: Bool[ndarray, "n"], length_bytes: Int[ndarray, "n"], name_key: UInt64[ndarray, "n"], round_number: int,
    rate_mbps: float,
) -> tuple[ndarray, Int[ndarray, "n"]]:  # fmt: skip
    """Messages as segments, by author, and how many each radio's message has."""
    talkers = np.flatnonzero(talks)
    count, payload_bytes = segments(length_bytes[talkers])
    n_segments = np.zeros(len(talks), np.int64)
    n_segments[talkers] = count
    units = np.zeros(int(count.sum()), UNIT)
    units["author"] = np.repeat(talkers, count)
    units["number"] = np.arange(len(units)) - np.repeat(np.cumsum(count) - count, count)
    units["payload_bytes"] = np.repeat(payload_bytes, count)
    units["airtime_ns"] = airtime_ns(units["payload_bytes"], rate_mbps)
    named = rng.keys(np.uint64(round_number), name_key[units["author"]], units["number"])
    units["seq"] = named >> np.uint64(24)  # 40 bits are allowed
    return units, n_segments


def _idle(
    air: Air, links: channel.Links, until_ns: int, chance: np.uint64, receiver: ReceiverParams, access: AccessParams,
    congestion: DccParams,
) -> None:  # fmt: skip
    """Let the time between two rounds pass."""
    since_ns = air.state.now_ns
    none = np.zeros(0, np.int64)
    nothing = Packets(none, none.astype(np.uint64), none, none, none.astype(np.uint8), none, none)
    air.state, out = channel.play(air.state, links, nothing, until_ns, chance, receiver, access)
    for _ in range(min(int((until_ns - since_ns) * 1e-9 / congestion.period_s), 10)):
        air.control = dcc.react(air.control, links.key, np.minimum(out.busy_strong, 1.0), congestion)
