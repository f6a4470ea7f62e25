"""Trust models of the literature beside TruPercept and the beta model: one file per model.

Question: would another model have told liars from honest vehicles better, on the same evidence? For researchers who
compare trust models. Tests: `tests/addons/trust_models`, `tests/trust`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "trust": {
            "beta_discounted": "cosim.addons.trust_models.beta_discounted:BetaDiscounted",
            "beta_by_kind": "cosim.addons.trust_models.beta_by_kind:BetaByKind",
            "beta_correlated": "cosim.addons.trust_models.beta_correlated:BetaCorrelated",
            "subjective_logic": "cosim.addons.trust_models.subjective_logic:SubjectiveLogic",
            "mate": "cosim.addons.trust_models.mate:Mate",
            "raya_majority": "cosim.addons.trust_models.raya:Raya",
            "raya_most_trusted": "cosim.addons.trust_models.raya:RayaMostTrusted",
            "raya_weighted": "cosim.addons.trust_models.raya:RayaWeighted",
            "raya_bayes": "cosim.addons.trust_models.raya:RayaBayes",
            "raya_dempster_shafer": "cosim.addons.trust_models.raya:RayaDempsterShafer",
            "minhas": "cosim.addons.trust_models.minhas:Minhas",
            "announcement": "cosim.addons.trust_models.announcement:Announcement",
            "eigentrust": "cosim.addons.trust_models.eigentrust:EigenTrust",
            "report_count": "cosim.addons.trust_models.report_count:ReportCount",
            "majority_ban": "cosim.addons.trust_models.majority_ban:MajorityBan",
            "dawid_skene": "cosim.addons.trust_models.dawid_skene:DawidSkene",
            "dawid_skene_online": "cosim.addons.trust_models.dawid_skene_online:DawidSkeneOnline",
            "evaluator_trust": "cosim.addons.trust_models.evaluator_trust:EvaluatorTrust",
            "self_first": "cosim.addons.trust_models.self_first:SelfFirst",
            "median_groups": "cosim.addons.trust_models.median_groups:MedianGroups",
            "miso_v": "cosim.addons.trust_models.miso_v:MisoV",
            "prbi": "cosim.addons.trust_models.prbi:Prbi",
            "false_discovery": "cosim.addons.trust_models.false_discovery:FalseDiscovery",
            "denied_share": "cosim.addons.trust_models.plain_rules:DeniedShare",
            "mean_score": "cosim.addons.trust_models.plain_rules:MeanScore",
            "belief_graph": "cosim.addons.trust_models.belief_graph:BeliefGraph",
        },
    },
)
