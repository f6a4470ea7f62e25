"""Trust models by name: one file per model, behind `interface.TrustModel`."""

from trust.models.announcement import Announcement
from trust.models.belief_graph import BeliefGraph
from trust.models.beta import Beta
from trust.models.beta_by_kind import BetaByKind
from trust.models.beta_correlated import BetaCorrelated
from trust.models.beta_discounted import BetaDiscounted
from trust.models.dawid_skene import DawidSkene
from trust.models.dawid_skene_online import DawidSkeneOnline
from trust.models.eigentrust import EigenTrust
from trust.models.evaluator_trust import EvaluatorTrust
from trust.models.interface import ScoresObjects, TrustModel, params_of
from trust.models.majority_ban import MajorityBan
from trust.models.mate import Mate
from trust.models.median_groups import MedianGroups
from trust.models.minhas import Minhas
from trust.models.miso_v import MisoV
from trust.models.raya import Raya, RayaBayes, RayaDempsterShafer, RayaMostTrusted, RayaWeighted
from trust.models.report_count import ReportCount
from trust.models.self_first import SelfFirst
from trust.models.subjective_logic import SubjectiveLogic
from trust.models.trupercept import TruPercept

MODELS: dict[str, type[TrustModel]] = {
    "trupercept": TruPercept,
    "beta": Beta,
    "beta_discounted": BetaDiscounted,
    "beta_by_kind": BetaByKind,
    "beta_correlated": BetaCorrelated,
    "subjective_logic": SubjectiveLogic,
    "mate": Mate,
    "raya_majority": Raya,
    "raya_most_trusted": RayaMostTrusted,
    "raya_weighted": RayaWeighted,
    "raya_bayes": RayaBayes,
    "raya_dempster_shafer": RayaDempsterShafer,
    "minhas": Minhas,
    "announcement": Announcement,
    "eigentrust": EigenTrust,
    "report_count": ReportCount,
    "majority_ban": MajorityBan,
    "dawid_skene": DawidSkene,
    "dawid_skene_online": DawidSkeneOnline,
    "evaluator_trust": EvaluatorTrust,
    "self_first": SelfFirst,
    "median_groups": MedianGroups,
    "miso_v": MisoV,
    "belief_graph": BeliefGraph,
}
"""Constructors by the value of `trust.model`."""

__all__ = ["MODELS", "ScoresObjects", "TrustModel", "params_of"]
