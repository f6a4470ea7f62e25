"""One step: equipped vehicles perceive, broadcast, evaluate each other's detections, update trust, and fuse.

This is the detection and decision cycle of TruPercept (section "Summary"), for all vehicles at once.

In a step that begins at time t, vehicles sweep and detect at t. Detection messages are sent from t on, in a round that
lasts `Config.round_s`. Vehicles evaluate what has arrived by its end. Evaluation messages are sent from then on, in a
second round of this length. Then every vehicle fuses with the trust that it knows. The trust server uses the
evaluations that have reached it by t, and broadcasts trust at t. Roadside units pass this broadcast on during the
round of evaluations.

Only drivers make a later step depend on what vehicles fuse. Without them, a run fuses beside the next step. With more
than one thread, servers publish while vehicles perceive, and the detections of all messages are paired while the
channel decides who receives them. Such a stage counts for as long as the step waits for it.

A message may outlast its round: its frames wait for the channel. It then arrives in a round of a later step
(`cosim.step.late`). A detection message is too old at t + timeout (`radio.timeout_s`), an evaluation message at
t + 2 timeout.

Not all vehicles need to sense in a step (`cosim.traffic.schedule`). Those that do perceive, send, evaluate, look up
and fuse; all receive. The inbox then keeps messages for vehicles that sense later.

Piggybacked evaluations wait for the sender's next detection message. They are too late for fusion, so each vehicle
fuses with its own evaluations only. They are in time for trust.
"""

from dataclasses import replace
from functools import partial

from jaxtyping import Float
from numpy import ndarray

from cosim.base.deferred import Deferred
from cosim.base.threads import beside
from cosim.radio.message_round import RoundKind
from cosim.step.attack_outcomes import attack_outcomes
from cosim.step.broadcast import broadcast_detections, broadcast_evaluations, hear
from cosim.step.claims import claims_of
from cosim.step.comparing import Comparison, compare_objects
from cosim.step.evaluate import evaluate_objects
from cosim.step.exchange import Exchange, Times, Vehicles, stations_of
from cosim.step.fuse import beliefs_of, fuse_objects
from cosim.step.inbox import Inbox
from cosim.step.known import Known
from cosim.step.late import joined, of_this_step
from cosim.step.listing import list_objects, senders_among, senders_of
from cosim.step.parts import Parts
from cosim.step.precomputed import NOTHING_PRECOMPUTED, Precomputed
from cosim.step.reports import carrier_of, deliver_late, next_carried, update_trust
from cosim.step.result import Sensed, StepResult
from cosim.step.sense import identify, mislead, perceive, position, track_objects
from cosim.step.state import State
from cosim.step.tracking import count_in_encounters, track_attacks, track_receptions
from cosim.step.trust import (
    control_relays,
    follow_encounters,
    follow_senders,
    look_up,
    own_trust_of,
    publish,
    receive_from_rsus,
)
from cosim.traffic.driver import Beliefs, memory_s
from cosim.world import World


def step(
    world: World, state: State, parts: Parts, precomputed: Precomputed = NOTHING_PRECOMPUTED
) -> tuple[State, StepResult]:
    """Simulate one step.

    The step consumes `state` (see `State`) and changes nothing else. The same step from a copy of the state has the
    same result. Stages read only their arguments. Only this file replaces the state, with `s = replace(s, ...)`.

    Parameters
    ----------
    world
        All actors on the road in this step.
    state
        State after the step before.
    parts
        Components that the config names.
    precomputed
        Values of this step that another thread computes. The result is the same without them.

    Returns
    -------
    The state after the step, and the step's results.

    Raises
    ------
    RuntimeError
        If an earlier step has consumed `state`.
    """
    s = state.consume()
    watch = parts.watch
    now = Times.of(world.step, parts.config)
    dt_s = parts.config.traffic.step_s

    own_trust = own_trust_of(world, s.trust, s.pseudonyms, now, parts)
    pseudonyms, vehicles, ended = identify(world, s.pseudonyms, own_trust, now, parts)
    last_speeds, acceleration_mps2 = s.last_speeds.next(world.step, world.actor, world.speed_mps, dt_s)
    with watch("encounters"):
        near = parts.near_pairs(world) if precomputed.near_pairs is None else precomputed.near_pairs()
        encounters, trust, closed = follow_encounters(s.encounters, near, s.trust, pseudonyms, vehicles, now, parts)
    s = replace(s, pseudonyms=pseudonyms, last_speeds=last_speeds, encounters=encounters, trust=trust)

    sensed, beliefs = None, None
    if parts.senses(world.step) and len(vehicles):
        s, sensed, beliefs = _cycle(world, s, vehicles, own_trust, acceleration_mps2, now, parts, precomputed)

    with watch("driver"):
        driver, commands = parts.driver.commands(s.driver, world, beliefs, dt_s)
        reactions = s.reaction_truth.of(commands, world, dt_s)
    return replace(s, driver=driver), StepResult(
        world=world, encounters=closed, ended_pseudonyms=ended, sensed=sensed, commands=commands, reactions=reactions
    )


def _cycle(
    world: World,
    s: State,
    vehicles: Vehicles,
    own_trust: Float[ndarray, "n"] | None,
    acceleration_mps2: Float[ndarray, "n"],
    now: Times,
    parts: Parts,
    precomputed: Precomputed,
) -> tuple[State, Sensed, Beliefs | None]:
    """The paper's cycle, from sweeps to fused objects. Beliefs are None if the driver does not use them.

    `own_trust` is the trust in each actor, as the actor last received it, NaN if none; None if no attack reads it.
    """
    config, watch = parts.config, parts.watch
    with watch("server"):
        publishing = beside(partial(publish, s.trust, s.pseudonyms, vehicles, now, parts))
    observed = perceive(world, vehicles, precomputed, parts)
    with watch("attack"):
        sends = senders_among(world, vehicles)
        attacks = parts.adversary.active(s.attacks, world, now.begin_s, own_trust, sends)
        observed = mislead(observed, attacks)
    position_errors, positioned = position(world, vehicles, observed, s.position_errors, config)
    with watch("track objects"):
        tracks, positioned = track_objects(world, vehicles, positioned, s.tracks, now, parts)
    with watch("server"):
        trust, pseudonyms, published = publishing()
    with watch("attack"):
        pseudonyms, senders = senders_of(world, vehicles, attacks, pseudonyms, parts)
        stations = stations_of(world, vehicles.row, parts.rsus, config.radio.antenna_above_roof_m)
        exchange = Exchange.of(world, now, vehicles, senders, stations, attacks)
        cpm, listed = list_objects(exchange, positioned, acceleration_mps2, s.cpm, s.medium, parts)
    with watch("trust"):
        exchange = control_relays(trust, s.known_senders, exchange, pseudonyms, parts)

    def prepare() -> tuple[Inbox, Known, Comparison]:
        inbox, known = s.inbox.known(exchange, listed, parts)
        return inbox, known, Comparison.of(exchange, known, positioned, parts)

    with watch("match"):
        preparing = beside(prepare)
    with watch("radio"):
        medium = s.medium if precomputed.with_links is None else precomputed.with_links(s.medium)
        sent_clouds = None if parts.early is None else parts.early.offered(observed)
        cloud_bytes = None
        if sent_clouds is not None and config.early_fusion.medium == "radio":
            cloud_bytes = sent_clouds.length_bytes
        medium, cpms = broadcast_detections(exchange, listed, s.piggybacked, cloud_bytes, medium, parts)
        has_message = cpms.length_bytes[exchange.senders.own] > 0
        pseudonyms = parts.pseudonyms.counted(pseudonyms, exchange.sensing.actor[has_message])
        cpm = hear(cpm, exchange, positioned, listed, cpms, config)
    carry_evaluations = RoundKind.EVALUATION if config.radio.evaluations == "alone" else RoundKind.CPM
    with watch("match"):
        inbox, known, comparison = preparing()
        inbox = inbox.with_late(exchange, cpms.late, carry_evaluations)
        known = inbox.received(exchange, known, cpms)
    compared, groups = compare_objects(exchange, known, comparison, parts)
    del comparison, preparing  # its memory is large
    if precomputed.sweeps_are_read is not None:
        precomputed.sweeps_are_read()
    with watch("evaluate"):
        claims = claims_of(exchange, known, compared, listed.tracks, parts)
        evaluated = evaluate_objects(exchange, known, compared, claims, config)
    with watch("fuse"):
        keeping = beside(partial(inbox.next, exchange, listed, groups, evaluated))
    with watch("radio"):
        trust, on_rsus = parts.trust.pending_rsu_broadcast(trust, now.step, now.evaluated_s)
        medium, reports = broadcast_evaluations(exchange, evaluated, on_rsus, medium, parts)
        rounds = cpms, reports
    with watch("track"):
        tracking_rounds = beside(partial(track_receptions, s.inter_reception, exchange, rounds, s.inbox))
    with watch("trust"):
        trust, informed = receive_from_rsus(trust, exchange, on_rsus, rounds, published.informed, parts)
        piggybacked, carrier = carrier_of(exchange, evaluated, s.piggybacked, rounds, parts)
        trust, uplink = update_trust(trust, exchange, listed, evaluated, carrier, pseudonyms, parts)
        late = [messages for one in rounds for messages in one.late if messages.kind == carry_evaluations]
        trust, late_uplink = deliver_late(trust, exchange, (*s.carried, carrier), late, pseudonyms, parts)
        inbox = inbox.with_late(exchange, reports.late, carry_evaluations)
        reports_used = inbox.reports_used(exchange, carrier.receptions.vehicles)
        known_senders = follow_senders(s.known_senders, exchange, listed, cpms, pseudonyms, parts)
        trust, known_senders, looked_up = look_up(
            trust, known_senders, exchange, known, reports_used, pseudonyms, parts
        )
    with watch("fuse"):
        evaluations = inbox.evaluations_used(exchange, evaluated, len(listed.objects))
        scorers = parts.trust.scorers(trust)
        fused = Deferred(partial(fuse_objects, scorers, groups, evaluations, looked_up, parts))
        if config.driver.model != "none" or any(scorer is not None for scorer in scorers):
            fused()  # drivers react to it, or it depends on models that the next step changes
        received_cpms = joined([cpms.accepted.vehicles, *of_this_step(exchange, reports.late, RoundKind.CPM)])
        own_round = carry_evaluations == RoundKind.EVALUATION
        received_reports = carrier.receptions.vehicles if own_round else received_cpms
        inbox = keeping().with_received(exchange, inbox, received_cpms, received_reports)
        clouds, early = s.clouds, None
        if parts.early is not None and sent_clouds is not None:
            late_clouds = (*cpms.late_clouds, *reports.late_clouds)
            clouds, early = parts.early.fuse(
                clouds, exchange, observed, positioned.error, sent_clouds, cpms.clouds, late_clouds
            )
    beliefs, reaction_truth = None, s.reaction_truth
    if config.driver.model != "none":
        with watch("driver"):
            beliefs = beliefs_of(fused()[0], exchange, known, world, positioned.error)
            kept_s = memory_s(parts.driver) + parts.schedule.longest_steps * config.traffic.step_s
            reaction_truth = reaction_truth.next(exchange, listed, kept_s, config.traffic.step_s)
    with watch("track"):
        attack_start = track_attacks(s.attack_start, exchange, positioned.observed, listed, evaluated)
        rounds, inter_reception, reach = tracking_rounds()
        encounters = count_in_encounters(s.encounters, exchange, rounds, looked_up, known, compared)
        outcomes = Deferred(lambda: attack_outcomes(exchange, positioned.world, known, compared, fused()))
    sensed = Sensed(
        vehicles=vehicles,
        sensing=exchange.sensing,
        senders=senders,
        positioned=positioned,
        listed=listed,
        known=known,
        rounds=rounds,
        carried=(*s.carried, carrier),
        reach=reach,
        evaluated=evaluated,
        looked_up=looked_up,
        fused=fused,
        early=early,
        published=published.scores,
        servers=parts.trust.traffic(uplink.plus_late(late_uplink), informed),
        attack_outcomes=outcomes,
    )
    s = replace(
        s,
        trust=trust,
        pseudonyms=pseudonyms,
        position_errors=position_errors,
        tracks=tracks,
        cpm=cpm,
        medium=medium,
        inbox=inbox,
        clouds=clouds,
        piggybacked=piggybacked,
        carried=next_carried(s.carried, carrier, now, config),
        known_senders=known_senders,
        reaction_truth=reaction_truth,
        attack_start=attack_start,
        inter_reception=inter_reception,
        encounters=encounters,
        n_dropped=s.n_dropped + listed.n_dropped,
    )
    return s, sensed, beliefs
