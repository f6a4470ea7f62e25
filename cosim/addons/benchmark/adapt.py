"""An adversary that knows a trust model: it searches the mix and the schedule of attacks that harm it most.

Nothing is simulated again. A policy chooses, for every attacker and step, between the messages of the world without
attack and those of the world with an attack, together with all evaluations about them, and which evaluations its
vehicles falsify. This is exact where evaluations of one message do not depend on other messages, and receptions do not
depend on the content of messages; both hold in the simulation but for the load of the channel. The model is played anew
for every policy.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.optimize import differential_evolution

from cosim.addons.benchmark.evidence import (
    HONEST,
    TABLES,
    EvidenceRules,
    EvidenceSet,
    EvidenceStream,
    Rows,
    merged,
    packed,
    taken,
)
from cosim.addons.benchmark.play import Candidate, Script, play
from cosim.addons.benchmark.score import TRUE_DETECTIONS, Advance, Counts, Figures, counts, figures
from cosim.base import rng

COLLUSION = "collusion"
"""Attack from whose evidence falsified evaluations are taken: it falsifies all evaluations of others."""


@dataclass(frozen=True, slots=True)
class Policy:
    """What all attackers of a world do."""

    attack: str
    """Attack on detections: `none`, or one of the set."""
    lie_p: float
    """Share of every period, from its beginning, in which messages lie; the rest are true."""
    period_s: float
    """Length of a period [s]."""
    sleep_s: float
    """Time after the start of the attacks in which the attackers are still honest [s]."""
    deny_p: float
    """Share of the honest vehicles whose detections are denied, drawn from their pseudonyms: the same for all
    attackers."""
    praises: bool
    """Whether attackers confirm each other's detections."""
    disguised: bool = False
    """Whether falsified evaluations have the values of honest ones: each is drawn from the confirmations or the denials
    of the world without attack. Otherwise they are 1 or -1 with full visibility, as under `collusion`."""

    @property
    def words(self) -> str:
        """The policy in words."""
        lies = f"{self.attack} in {self.lie_p:.0%} of every {self.period_s:.0f} s"
        if self.attack == HONEST:
            lies = "tells the truth"
        denies = f", denies {self.deny_p:.0%} of the honest" if self.deny_p > 0 else ""
        sleeps = f", from {self.sleep_s:.0f} s on" if self.sleep_s >= 1 else ""
        praises = ", praises accomplices" if self.praises else ""
        disguise = " in disguise" if self.disguised and (denies or praises) else ""
        return lies + denies + praises + disguise + sleeps

    def lies(self, step: Int[ndarray, "n"], rules: EvidenceRules) -> Bool[ndarray, "n"]:
        """Whether attackers send false detections in these steps."""
        since_s = (step - rules.start_step) * rules.dt_s - self.sleep_s
        is_on = np.mod(since_s, self.period_s) < self.lie_p * self.period_s - 1e-9
        return (since_s >= 0) & is_on & (self.attack != HONEST)


_PERIODS_S, _SLEEPS_S = (2.0, 30.0), (0.0, 30.0)


def _policy(x: Float[ndarray, "7"], attacks: Sequence[str]) -> Policy:
    """The policy of a point of the search."""
    attack, lie_p, period_s, sleep_s, deny_p, praises, disguised = x.tolist()
    return Policy(
        attacks[round(attack)],
        lie_p,
        period_s,
        sleep_s,
        deny_p,
        bool(round(praises)),
        bool(round(disguised)),
    )


@dataclass(frozen=True, slots=True)
class AdaptedEvidence:
    """What a world offers to a policy."""

    honest: EvidenceStream
    colluding: EvidenceStream
    attacked: EvidenceStream
    """With the policy's attack on detections; the world without attack if it has none."""

    def under(self, policy: Policy, rules: EvidenceRules) -> EvidenceStream:
        """The evidence under a policy.

        Messages of attackers, and what others evaluate about their detections, are those under the attack in steps in
        which the policy lies, and otherwise those of the world without attack. Attackers evaluate denied vehicles, and
        accomplices if they praise, as under `collusion`, from the end of their sleep on. What they evaluate of
        accomplices' false detections is confirmed with full visibility if they praise. A disguised policy then draws
        other values for all that they falsify.
        """
        attacks = self.attacked.attackers()
        awake = rules.start_step + policy.sleep_s / rules.dt_s

        def chosen(name: str, **who: str) -> list[Rows]:
            """Rows without attack, and those that the attack replaces.

            `who` has the columns of pseudonyms that may attack, and of each the column of the step in which it may.
            """

            def attacked(rows: Rows) -> Bool[ndarray, "n"]:
                """Whether each row is of a pseudonym that attacks in a step in which the policy lies."""
                lie = []
                for one, when in who.items():
                    lies = policy.lies(rows[when], rules)
                    lie.append(attacks[rows[one]] & lies)
                return np.any(lie, axis=0)

            plain, false = getattr(self.honest, name), getattr(self.attacked, name)
            return [taken(plain, ~attacked(plain)), taken(false, attacked(false))]

        plain = chosen("evaluations", observer="detection_step", evaluator="step")
        evaluations = dict(_union("evaluations", plain))
        by, of, step, said = (evaluations[c] for c in ("evaluator", "observer", "step", "detection_step"))
        active = attacks[by] & (step >= awake)
        falsified = active & ~attacks[of] & self._denied(of, policy)
        praised = active & attacks[of] & policy.praises
        is_false = praised & policy.lies(said, rules)
        for name in ("evaluation", "visibility"):
            evaluations[name] = np.where(is_false, 100, evaluations[name])
        told = self.colluding.evaluations
        praises = policy.praises & ~policy.lies(told["detection_step"], rules)
        denies = self._denied(told["observer"], policy)
        wanted = np.where(attacks[told["observer"]], praises, denies)
        wanted &= attacks[told["evaluator"]] & (told["step"] >= awake)
        keeps = ~(falsified | (praised & ~is_false))
        false = [taken(told, wanted), taken(evaluations, is_false)]
        if policy.disguised:
            false = [self._disguised(rows) for rows in false]
        true = taken(evaluations, keeps & ~is_false)
        reports = [self.honest.reports, *chosen("reports", evaluator="step")[1:]]
        reports.append(taken(self.colluding.reports, attacks[self.colluding.reports["evaluator"]]))
        return EvidenceStream(
            _union("detections", chosen("detections", observer="step")),
            _union("reports", reports),
            _union("evaluations", [*false, true]),
            _union("lookups", chosen("lookups", sender="message_step")),
            self.attacked.pseudonyms,
        )

    def _disguised(self, rows: Rows) -> Rows:
        """Falsified evaluations with values of honest ones of the same sign about others' objects, drawn per row."""
        plain = self.honest.evaluations
        key = rng.key(1, rng.Stream.ATTACK_TIME)
        drawn = rng.uniforms(key, packed("evaluations", rows).astype(np.uint64))[:, 0]
        found = {**rows, **{name: rows[name].copy() for name in ("evaluation", "visibility")}}
        is_other = plain["detection_index"] > 0
        for sign in (1, -1):
            mine = np.flatnonzero(np.sign(rows["evaluation"]) == sign)
            pool = np.flatnonzero((np.sign(plain["evaluation"]) == sign) & is_other)
            if len(pool):
                at = pool[(drawn[mine] * len(pool)).astype(np.int64)]
                for name in ("evaluation", "visibility"):
                    found[name][mine] = plain[name][at]
        return found

    def _denied(self, pseudonym: Int[ndarray, "n"], policy: Policy) -> Bool[ndarray, "n"]:
        key = rng.key(0, rng.Stream.ATTACK_TIME)
        return rng.uniforms(key, pseudonym.astype(np.uint64))[:, 0] < policy.deny_p


def _union(name: str, parts: Sequence[Rows]) -> Rows:
    """Rows of several tables; of rows with the same key, the first."""
    rows = {}
    for column in TABLES[name].columns:
        rows[column] = np.concatenate([part[column] for part in parts])
    _, first = np.unique(packed(name, rows), return_index=True)
    return merged(name, taken(rows, first))


@dataclass(frozen=True, slots=True)
class WorstCase:
    """What the search found."""

    policy: Policy
    figures: Figures
    """On all worlds of the set; the search used some of them."""
    budget: int
    """Number of policies that were tried."""
    n_worlds: int
    """Number of worlds in which each was played."""
    seed: int


@dataclass(frozen=True, slots=True)
class Search:
    """The search for the policy that harms a model most."""

    evidence: EvidenceSet
    candidate: Candidate
    threshold: float
    """The model's, of `score.threshold_of`: the adversary knows it."""
    advance: Advance

    def attacks(self) -> list[str]:
        """Attacks on detections among which a policy chooses: those of which the evidence has a trace."""
        rows, cases = self.evidence.tables["evaluations"], self.evidence.rules.cases
        traced = set(np.unique(rows["case"]).tolist())
        return [HONEST] + [
            name for case, name in enumerate(cases) if case and case in traced and name not in TRUE_DETECTIONS
        ]

    def worlds(self) -> list[int]:
        """Worlds of the search: of each city, the first of the highest penetration."""
        found: dict[str, int] = {}
        for number, place in enumerate(self.evidence.worlds):
            best = found.setdefault(place.city, number)
            if place.penetration_p > self.evidence.worlds[best].penetration_p:
                found[place.city] = number
        return sorted(found.values())

    def run(self, budget: int, seed: int = 0) -> WorstCase:
        """Search with differential evolution (Storn and Price 1997; SciPy).

        Parameters
        ----------
        budget
            Number of policies to try, at least that of `first`, with which the search begins.
        seed
            Seed of the search. The same seed finds the same policy.
        """
        attacks, rules, worlds = self.attacks(), self.evidence.rules, self.worlds()
        if COLLUSION not in rules.cases or attacks == [HONEST]:
            raise ValueError(
                f"--adapt: this set has the cases {', '.join(rules.cases)}. The adversary mixes {COLLUSION} with an "
                "attack on detections. Record a set that has both."
            )
        first = self.first(attacks)
        if budget < len(first):
            raise ValueError(f"--budget {budget}: the search begins with {len(first)} policies. Give at least that.")
        tried: list[tuple[float, Policy]] = []

        def loss(x: ndarray) -> float:
            if len(tried) >= budget:
                return 0.0  # the last generation is cut off: the search has ended
            policy = _policy(x, attacks)
            harm = figures([self._counts(world, policy, rules) for world in worlds]).harm.value
            tried.append((harm, policy))
            self.advance(f"{self.candidate.name}: adversary", len(tried), budget, policy.words)
            return -harm

        bounds = [
            (0, len(attacks) - 1),
            (0.05, 1.0),
            _PERIODS_S,
            _SLEEPS_S,
            (0.0, 1.0),
            (0, 1),
            (0, 1),
        ]
        differential_evolution(
            loss,
            bounds,
            init=first,
            maxiter=-(-budget // len(first)),
            tol=0.0,
            atol=0.0,
            polish=False,
            rng=seed,
            integrality=[True, False, False, False, False, True, True],
        )
        _, policy = max(tried, key=lambda one: one[0])
        found = []
        for world in range(len(self.evidence.worlds)):
            found.append(self._counts(world, policy, rules))
            self.advance(f"{self.candidate.name}: worst policy", world + 1, len(self.evidence.worlds), "worlds")
        return WorstCase(policy, figures(found), len(tried), len(worlds), seed)

    def first(self, attacks: Sequence[str]) -> Float[ndarray, "p 7"]:
        """The first policies: each attack on detections, in all messages, alone, with collusion, and with collusion in
        disguise; and true detections with collusion against all vehicles and against some."""
        collusion = ((0.0, 0), (1.0, 0), (1.0, 1))
        begin = []
        for n in range(1, len(attacks)):
            begin += [(n, deny_p, hidden) for deny_p, hidden in collusion]
        begin += [(0, 1.0, 0), (0, 0.6, 1), (0, 0.3, 0)]
        period_s = _PERIODS_S[1]
        policies = []
        for n, deny_p, hidden in begin:
            policies.append([n, 1.0, period_s, 0.0, deny_p, deny_p > 0, hidden])
        return np.array(policies, float)

    def _counts(self, world: int, policy: Policy, rules: EvidenceRules) -> Counts:
        def stream(case: str) -> EvidenceStream:
            return self.evidence.stream(world, rules.cases.index(case))

        under = AdaptedEvidence(stream(HONEST), stream(COLLUSION), stream(policy.attack)).under(policy, rules)
        answers = play(Script.of(under, rules), self.candidate)
        return counts(under, answers, self.threshold, rules, policy.lies(under.lookups["message_step"], rules))
