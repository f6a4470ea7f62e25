"""The interface of trust models."""

from dataclasses import fields
from typing import Any, ClassVar, Protocol

from jaxtyping import Float, Int
from numpy import ndarray

from trust.object_reports import ObjectReports
from trust.tables import ReceivedEvaluations, TrustScores


class TrustModel(Protocol):
    """Trust of holders in subjects, from evaluations that the holders have received.

    A central trust server is the one holder `trust.tables.SERVER`; otherwise a holder is a vehicle's actor number.
    Subjects, evaluators and observers are pseudonyms. All are integers in [0, 2^31); so are steps, and seconds are
    `step * dt_s`. One instance keeps the scores of all holders. It can be copied with `copy.deepcopy` and pickled.
    Its scores do not depend on the order in which messages arrive. An evaluator sends one message per step.
    """

    Params: ClassVar[type]
    """Frozen dataclass of the model's own parameters, read from the section [trust] of the config."""

    def __init__(self, params: Any, dt_s: float) -> None: ...

    def open_step(
        self,
        step: int,
        pseudonyms: Int[ndarray, "n"],
        observer_row: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> None:
        """Begin a step and tell the model what was transmitted in it. It is called once per step, in order of time.

        Parameters
        ----------
        pseudonyms
            All pseudonyms that were present, ascending, including those without detections.
        observer_row
            Row in `pseudonyms` of each transmitted detection's observer.
        detection_index
            Number of each detection in its observer's message; 0 is the self report.
        score
            Score of each detection, in [0, 1].
        """
        ...

    def add_evaluations(self, received: ReceivedEvaluations) -> None:
        """Add evaluations that holders have received, including evaluations of earlier steps.

        The content is not checked yet: `trust.open_steps.OpenSteps` checks it against what was transmitted, and
        `ReceivedEvaluations.rows` and `by_observer` leave out values that are out of range.
        """
        ...

    def scores(self, now_step: int | None = None) -> TrustScores:
        """Trust of every (holder, subject) with evidence at a step (default: the newest one), sorted.

        `now_step` is at least the newest step given so far. A subject without evidence has no row.
        """
        ...


class ScoresObjects(Protocol):
    """A trust model that also scores the objects of a fusion, in place of `trust.method`."""

    def score_objects(self, reports: ObjectReports) -> Float[ndarray, "g"]:
        """Score the groups of detections. The call must not change the model.

        Parameters
        ----------
        reports
            Votes of vehicles on the groups, with the ego's trust in each vehicle.

        Returns
        -------
        Score in [0, 1] for each group, numbered as in `reports.group`.
        """
        ...


def params_of(model: Any, trust: object, own: dict[str, Any] | None = None) -> Any:
    """Parameters of a model from the section [trust].

    Parameters
    ----------
    trust
        `TrustParams`. Fields of the same name are copied.
    own
        Keys of the section that `TrustParams` does not have.

    Raises
    ------
    ValueError
        If the model does not have one of the keys in `own` either.
    """
    own = own or {}
    names = [f.name for f in fields(model.Params)]
    for name in own:
        if name not in names:
            raise ValueError(
                f"trust.{name}: the trust model {model.__name__} has no such parameter. It has: {', '.join(names)}."
            )
    shared = {name: getattr(trust, name) for name in names if hasattr(trust, name)}
    return model.Params(**(shared | own))
