"""Trust models by name: one file per model, behind `interface.TrustModel`."""

from cosim.addons.trust_models.announcement import Announcement
from cosim.addons.trust_models.belief_graph import BeliefGraph
from cosim.addons.trust_models.beta_by_kind import BetaByKind
from cosim.addons.trust_models.beta_correlated import BetaCorrelated
from cosim.addons.trust_models.beta_discounted import BetaDiscounted
from cosim.addons.trust_models.dawid_skene import DawidSkene
from cosim.addons.trust_models.dawid_skene_online import DawidSkeneOnline
from cosim.addons.trust_models.eigentrust import EigenTrust
from cosim.addons.trust_models.evaluator_trust import EvaluatorTrust
from cosim.addons.trust_models.majority_ban import MajorityBan
from cosim.addons.trust_models.mate import Mate
from cosim.addons.trust_models.median_groups import MedianGroups
from cosim.addons.trust_models.minhas import Minhas
from cosim.addons.trust_models.miso_v import MisoV
from cosim.addons.trust_models.raya import Raya, RayaBayes, RayaDempsterShafer, RayaMostTrusted, RayaWeighted
from cosim.addons.trust_models.report_count import ReportCount
from cosim.addons.trust_models.self_first import SelfFirst
from cosim.addons.trust_models.subjective_logic import SubjectiveLogic
from trust.models.beta import Beta
from trust.models.interface import ScoresObjects, TrustModel, params_of
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
