"""Further attacks: other ghosts, false own motion, several identities, and attacks on the channel.

Question: does trust still work against liars that the paper did not think of? For researchers in automotive security.
Tests: `tests/cosim/attacks`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "attack": {
            "approaching_ghost": "cosim.addons.attacks.ghosts:ApproachingGhost",
            "ghost_in_shadow": "cosim.addons.attacks.ghosts:GhostInShadow",
            "replay": "cosim.addons.attacks.ghosts:Replay",
            "stale": "cosim.addons.attacks.ghosts:Stale",
            "trust_flip": "cosim.addons.attacks.trust_flip:TrustFlip",
            "speed": "cosim.addons.attacks.self_report:Speed",
            "braking": "cosim.addons.attacks.self_report:Braking",
            "stop": "cosim.addons.attacks.self_report:Stop",
            "sybil": "cosim.addons.attacks.identity:Sybil",
            "denial_of_service": "cosim.addons.attacks.radio:DenialOfService",
            "jamming": "cosim.addons.attacks.radio:Jamming",
            "delay": "cosim.addons.attacks.radio:Delay",
            "server_flooding": "cosim.addons.attacks.radio:ServerFlooding",
        },
        "figure": {"attacks": "cosim.addons.attacks.figure:draw"},
        "topic": {"attack": "cosim.addons.attacks.effects"},
    },
)
