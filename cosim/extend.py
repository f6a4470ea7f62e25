"""Everything that the author of an extension needs: `from cosim.extend import ...`.

An extension is a class in the user's own file. A config names it as `mine.py:Class`.

| kind | config | methods of the class | arguments | results |
|---|---|---|---|---|
| detector | `[detector] model` | `detect`, and `recall` if it knows its probability of detection | \
`Sweeps`, `Observability`, `Boxes`, `DetectorDraws` | `Reports` |
| radio medium | `[radio] model` | `start`, `broadcast` | `Stations`, `Messages` | state and `MessageRound` |
| pseudonym policy | `[pseudonyms] policy` | `changes` | `PseudonymAges` | one bool per vehicle |
| trust model | `[trust] model` | `open_step`, `add_evaluations`, `scores`, and `score_objects` if it scores objects | \
`ReceivedEvaluations`, `ObjectReports` | `TrustScores`; one score per object |
| driver | `[driver] model` | `commands` | `World`, `Beliefs` | state and `SpeedCommands` |
| attack | `[[attacks]] attack` | one or more of `phantoms`, `detections`, `evaluations`, `identities`, `sending` | \
`Detections`, `EvaluationRows`, `AttackContext` | `Detections`; evaluation and visibility; numbers; `Sending` |

The protocols `Detector`, `Medium`, `PseudonymPolicy`, `TrustModel`, `ScoresObjects`, `Driver` and `Attack` document the
arguments of each method, with shapes and units. The parameters of a class are a frozen dataclass `Params` with types
and defaults. The constructor takes an instance of it.

| helper | purpose |
|---|---|
| `draws(seed, step, names, n)` | random numbers that depend on names; attacks use `context.uniforms`, detectors \
`draws.uniforms(seen)`, policies `ages.step_draws` |
| `TrustScores.of(...)` | trust scores from rows in any order, with defaults |
| `PairIndex`, `with_rows` | a row for each (holder, subject), and columns that grow with them |
| `MessageRound.of(...)` | a round of messages from receivers, messages and latencies |
| `Reports.of_actors`, `Reports.of_false_positives`, `Reports.concat` | the reports of a detector |
| `fabricated`, `placed`, `per_actor`, `certified` | false detections; numbers that an attack stores per actor |
| `SpeedCommands.none()`, `Sending.plain(n)` | no commands; honest sending |

Methods must not change their arguments, and work on copies instead. The results of methods are checked. A mistake ends
the run with one line that names the file, the line and the expected result.
"""

from cosim.attacks.attack import (
    Attack,
    AttackContext,
    EvaluationRows,
    Sending,
    certified,
    fabricated,
    per_actor,
    placed,
)
from cosim.base.codes import LosState, ObjectClass
from cosim.base.rng import draws
from cosim.messages.content import FABRICATED, SELF, SENSED, Detections
from cosim.messages.pseudonyms import PseudonymAges, PseudonymPolicy
from cosim.radio.medium import Medium
from cosim.radio.message_round import FrameOutcomes, MessageRound, Messages, Outcome, Receptions, RoundKind, Stations
from cosim.traffic.driver import Beliefs, Driver, Reasons, SpeedCommands
from cosim.world import LanePaths, World
from results.moments import File, Plan, Selection
from results.own_metrics import MetricRow
from results.run import Run
from sensors.boxes import Boxes
from sensors.detector import Detector
from sensors.evidence import Observability
from sensors.lidar import Sweeps
from sensors.reports import DetectorDraws, Reports
from sensors.scene import Shape
from trust.models import ScoresObjects, TrustModel
from trust.object_reports import ObjectReports
from trust.pair_index import PairIndex, with_rows
from trust.tables import SERVER, EvaluationMessages, ReceivedEvaluations, TrustScores

__all__ = [
    "FABRICATED",
    "SELF",
    "SENSED",
    "SERVER",
    "Attack",
    "AttackContext",
    "Beliefs",
    "Boxes",
    "Detections",
    "Detector",
    "DetectorDraws",
    "Driver",
    "EvaluationMessages",
    "EvaluationRows",
    "File",
    "FrameOutcomes",
    "LanePaths",
    "LosState",
    "Medium",
    "MessageRound",
    "Messages",
    "MetricRow",
    "ObjectClass",
    "ObjectReports",
    "Observability",
    "Outcome",
    "PairIndex",
    "Plan",
    "PseudonymAges",
    "PseudonymPolicy",
    "Reasons",
    "ReceivedEvaluations",
    "Receptions",
    "Reports",
    "RoundKind",
    "Run",
    "ScoresObjects",
    "Selection",
    "Sending",
    "Shape",
    "SpeedCommands",
    "Stations",
    "Sweeps",
    "TrustModel",
    "TrustScores",
    "World",
    "certified",
    "draws",
    "fabricated",
    "per_actor",
    "placed",
    "with_rows",
]
