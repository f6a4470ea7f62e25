"""Linkage of the pseudonyms of a vehicle, and revocation.

Trust models know subjects by a number. Without linkage that number is the pseudonym. A linkage authority gives all
linked pseudonyms of a vehicle one number. Pseudonyms are then renamed in everything that trust gets or returns.

References
----------
.. [1] ETSI TS 102 941 and SCMS (secondary sources): pseudonym certificates, linkage authorities, revocation lists.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.base.ragged import owner_of_rows, stable_order
from cosim.messages.pseudonyms import PseudonymParams, Pseudonyms, PseudonymState
from trust.params import KINDS
from trust.tables import SERVER, EvaluationMessages, TrustScores

PER_IDENTITY = 1024 * len(KINDS)
"""Detection indices of the n-th further identity of a linked vehicle begin at n times this. They keep the kinds of
claims apart (`trust.claims.claim_number`)."""
_UNKNOWN = (1 << 31) - 1
"""Subject number of pseudonyms that were never issued."""


class Linkage:
    """Renames pseudonyms to subjects of trust, and back."""

    def __init__(self, params: PseudonymParams, pseudonyms: Pseudonyms) -> None:
        self.mode = params.linkage
        self.n_accusations = params.n_accusations
        self.pseudonyms = pseudonyms

    @property
    def renames(self) -> bool:
        """Whether subjects can differ from pseudonyms."""
        return self.mode in ("server", "on_demand")

    def subjects(self, state: PseudonymState, pseudonym: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """Subject of trust of each pseudonym. Without renaming it is the pseudonym itself."""
        return self._resolved(state, pseudonym)[0] if self.renames else pseudonym

    def keys(
        self, state: PseudonymState, pseudonym: Int[ndarray, "n"], detection_index: Int[ndarray, "n"]
    ) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
        """Subject and index by which trust knows each detection.

        Parameters
        ----------
        pseudonym
            Pseudonym of the sender of each detection.
        detection_index
            Index of each detection in its message.

        Returns
        -------
        Subjects, and indices. Identities that are linked to one subject have separate ranges of indices
        (`PER_IDENTITY`).
        """
        if not self.renames:
            return pseudonym, detection_index
        subject, identity = self._resolved(state, pseudonym)
        return subject, detection_index + PER_IDENTITY * identity

    def messages(self, state: PseudonymState, sent: EvaluationMessages) -> EvaluationMessages:
        """The messages, with pseudonyms replaced by subjects."""
        if not self.renames:
            return sent
        observer, index = self.keys(state, sent.observer, sent.detection_index)
        return replace(sent, evaluator=self.subjects(state, sent.evaluator), observer=observer, detection_index=index)

    def scores(self, state: PseudonymState, scores: TrustScores) -> TrustScores:
        """The scores, with each subject replaced by its current or last pseudonym.

        Further identities that are linked to a subject have its score, too, because receivers look it up for them.
        Without the rows of pseudonyms that are known as another one since they were linked on demand.
        """
        if not self.renames:
            return scores
        vehicle = scores.subject
        if self.mode == "on_demand":
            # Identities that were used at once with the accused one have evidence of their own from before the link.
            is_subject = self.subjects(state, scores.subject) == scores.subject
            scores = scores.take(np.flatnonzero(is_subject))
            vehicle = self.pseudonyms.owners(state, scores.subject)[0]
            current = state.current[np.maximum(vehicle, 0)]
            linked = (vehicle >= 0) & (state.linked[np.maximum(vehicle, 0)] == scores.subject)
            linked &= current > scores.subject  # pseudonyms before the accused one stay subjects of their own
            subject = np.where(linked, current, scores.subject)
        else:
            subject = state.current[vehicle]
        further = state.extra[:, 1]
        holder = np.full_like(further, SERVER)
        at, there = scores.rows_of(holder, self.subjects(state, further))
        there &= ~np.isin(further, subject)
        row = np.append(np.arange(len(scores.subject)), at[there])
        subject = np.append(subject, further[there])
        order = np.lexsort((subject, scores.holder[row]))
        return replace(scores.take(row[order]), subject=subject[order])

    def accused(self, state: PseudonymState, reports: list[EvaluationMessages]) -> PseudonymState:
        """Count the accusations that have reached the server. Vehicles with enough of them are linked from then on.

        An accusation is one evaluator's report of one step in which the sum of its evaluations of a subject is
        negative. Evidence under the accused pseudonym and under all later ones then counts together.
        """
        if self.mode != "on_demand" or not reports:
            return state
        accused = []
        for sent in reports:
            of = owner_of_rows(np.diff(sent.ptr))
            of_evaluation = of << 32 | sent.observer.astype(np.int64)
            pair, which = np.unique(of_evaluation, return_inverse=True)
            with np.errstate(invalid="ignore"):
                evidence = np.nan_to_num(sent.evaluation * sent.visibility)
            total = np.bincount(which.reshape(-1), evidence, len(pair))
            subject = pair[total < 0] & (1 << 32) - 1
            evaluator = sent.evaluator[pair[total < 0] >> 32].astype(np.int64)
            others = subject != evaluator
            report = evaluator << 32 | sent.step
            accused.append(np.column_stack([subject[others], report[others]]))
        subject, report = np.concatenate(accused).T
        order = stable_order(subject)
        subject, begin = np.unique(subject[order], return_index=True)
        by = np.split(report[order], begin)[1:]  # nothing for nothing
        vehicle = self.pseudonyms.owners(state, subject)[0]
        known, linked = dict(state.accusations), state.linked.copy()
        for s, reports_of, v in zip(subject.tolist(), by, vehicle.tolist(), strict=True):
            if v >= 0 and linked[v] < 0:
                known[s] = known.get(s, set()).union(reports_of.tolist())  # units may relay a report more than once
                if len(known[s]) >= self.n_accusations:
                    linked[v] = s
                    del known[s]
        return replace(state, accusations=known, linked=linked)

    def _resolved(
        self, state: PseudonymState, pseudonym: Int[ndarray, "n"]
    ) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
        """Subject of each pseudonym, and its identity within the subject."""
        vehicle, identity = self.pseudonyms.owners(state, pseudonym)
        known = vehicle >= 0
        if self.mode == "server":
            return np.where(known, vehicle, _UNKNOWN), np.where(known, identity, 0)
        linked_to = np.full(len(vehicle), -1)
        if len(state.linked):
            linked_to = state.linked[np.maximum(vehicle, 0)]
        linked = known & (linked_to >= 0) & (pseudonym > linked_to)
        _, accused = self.pseudonyms.owners(state, linked_to)
        apart = identity ^ accused  # the accused identity, perhaps not the vehicle's own, keeps the first range
        return np.where(linked, linked_to, pseudonym), np.where(linked, apart, 0)


class Revocation:
    """Revokes the certificates of vehicles whose trust is too low."""

    def __init__(self, params: PseudonymParams, linkage: Linkage) -> None:
        self.how, self.below = params.revocation, params.revoke_below
        self.min_evaluations, self.list_every_s = params.min_evaluations, params.list_every_s
        self.linkage = linkage

    def decided(self, state: PseudonymState, scores: TrustScores | None, step: int, dt_s: float) -> PseudonymState:
        """Revoke subjects by the trust that the server has computed.

        Parameters
        ----------
        scores
            Scores of the acting server by subject. None if it computed none in this step.
        """
        if self.how == "none" or scores is None:
            return state
        low = (scores.trust < self.below) & (scores.n_evaluations >= self.min_evaluations)
        new = [s for s in scores.subject[low].tolist() if s not in state.revoked]
        if not new:
            return state
        from_step = step
        if self.how == "list":
            every = max(1, round(self.list_every_s / dt_s))
            from_step = -(-step // every) * every
        return replace(state, revoked=state.revoked | dict.fromkeys(new, from_step))

    def valid(
        self, state: PseudonymState, pseudonym: Int[ndarray, "m"], step: int
    ) -> tuple[Bool[ndarray, "m"], PseudonymState]:
        """Whether receivers accept the messages of each pseudonym in this step.

        Returns
        -------
        True where they are accepted; and the state, which stores the first step in which each pseudonym was refused.
        """
        if not state.revoked:
            return np.ones(len(pseudonym), bool), state
        subject = self.linkage.subjects(state, pseudonym)
        decided = np.array(list(state.revoked))
        decided_step = np.array(list(state.revoked.values()))
        if self.how == "not_renewed":  # the authority that issues certificates knows their owners
            owners = self.linkage.pseudonyms.owners
            barred = decided if self.linkage.mode == "server" else owners(state, decided)[0]
            vehicle, _ = owners(state, pseudonym)
            n = int(max(vehicle.max(initial=0), barred.max(initial=0))) + 1
            last = np.full(n, np.iinfo(np.int64).max)
            is_known = barred >= 0
            np.minimum.at(last, barred[is_known], decided_step[is_known])
            since = self.linkage.pseudonyms.since(state, pseudonym)
            bad = (vehicle >= 0) & (since > last[vehicle])
        else:
            begun = decided[decided_step <= step]
            bad = np.isin(subject, begun)
        if not bad.any():
            return ~bad, state
        first = dict(state.refused)
        for p in pseudonym[bad].tolist():
            first.setdefault(p, step)
        return ~bad, replace(state, refused=first)


def check_server(params: PseudonymParams, attacks: Sequence[Any], hosts: Sequence[str]) -> None:
    """Raise a ValueError of one line if something needs a trust server and there is none.

    Parameters
    ----------
    attacks
        `[[attacks]]` sections.
    hosts
        `trust.host` of the acting trust, then of the variants.
    """
    if params.linkage in ("server", "on_demand") and set(hosts) != {"central"}:
        other = next(host for host in hosts if host != "central")
        raise ValueError(
            f'pseudonyms.linkage = "{params.linkage}" needs a trust server, but trust.host = "{other}". '
            'Set trust.host = "central" in [trust] and in every variant, or another pseudonyms.linkage.'
        )
    if params.revocation != "none" and hosts[0] != "central":
        raise ValueError(
            f'pseudonyms.revocation = "{params.revocation}" is decided by the trust server, but trust.host = '
            f'"{hosts[0]}". Set trust.host = "central", or pseudonyms.revocation = "none".'
        )
    for number, attack in enumerate(attacks):
        if attack.reads_trust and hosts[0] != "central":
            key = "renewal" if attack.renewal == "whitewashing" else "when"
            raise ValueError(
                f'attacks.{number}.{key} = "{getattr(attack, key)}" needs the trust values of a trust server, '
                f'but trust.host = "{hosts[0]}". Set trust.host = "central", or another {key}.'
            )
