"""Options of SUMO 1.28 in a .sumocfg: which are passed on, which are ignored, which are refused.

An allow-list: SUMO never reads the user's configuration, it reads a copy that holds the options of `READS` and
`PASSED` only. The lists cover `sumo --save-template`; an option that is in none of them is refused.
"""

READS = (
    "net-file", "route-files", "additional-files", "weight-files", "load-state", "astar.all-distances",
    "astar.landmark-distances", "device.fcd-replay.files",
)  # fmt: skip
"""Options that name files to read."""

REFUSED = {
    "configuration-file": "names another configuration",
    "save-configuration": "writes a file and ends",
    "save-configuration.relative": "goes with save-configuration",
    "save-template": "writes a file and ends",
    "save-schema": "writes a file and ends",
    "save-commented": "goes with save-template",
    "help": "prints a text and ends",
    "version": "prints a text and ends",
}
"""Options with which SUMO does something else than to simulate, and what."""

_IGNORED = """
    write-license write-metadata output-prefix output-suffix precision precision.geo output.compression
    output.format output.column-header output.column-separator human-readable-time netstate-dump
    netstate-dump.empty-edges netstate-dump.precision emission-output emission-output.precision emission-output.geo
    emission-output.step-scaled emission-output.attributes battery-output battery-output.precision elechybrid-output
    elechybrid-output.precision elechybrid-output.aggregated chargingstations-output
    chargingstations-output.aggregated chargingstations-output.aggregated.write-unfinished
    overheadwiresegments-output substations-output substations-output.precision fcd-output fcd-output.geo
    fcd-output.utm fcd-output.signals fcd-output.distance fcd-output.acceleration fcd-output.speed-relative
    fcd-output.max-leader-distance fcd-output.params fcd-output.filter-edges.input-file fcd-output.attributes
    fcd-output.filter-shapes fcd-output.skip-empty person-fcd-output device.ssm.filter-edges.input-file full-output
    queue-output queue-output.period queue-output.aggregation queue-output.speed-threshold queue-output.percentile
    queue-output.skip-empty vtk-output amitran-output summary-output summary-output.period person-summary-output
    tripinfo-output tripinfo-output.write-unfinished tripinfo-output.write-undeparted personinfo-output
    vehroute-output vehroute-output.exit-times vehroute-output.last-route vehroute-output.sorted vehroute-output.dua
    vehroute-output.cost vehroute-output.intended-depart vehroute-output.route-length
    vehroute-output.write-unfinished vehroute-output.skip-ptlines vehroute-output.incomplete
    vehroute-output.stop-edges vehroute-output.speedfactor vehroute-output.internal personroute-output link-output
    railsignal-block-output railsignal-vehicle-output bt-output lanechange-output lanechange-output.started
    lanechange-output.ended lanechange-output.xy stop-output stop-output.write-unfinished collision-output
    edgedata-output lanedata-output statistic-output deadlock-output save-state.times save-state.period
    save-state.period.keep save-state.prefix save-state.suffix save-state.files save-state.rng
    save-state.transportables save-state.constraints save-state.precision pedestrian.jupedsim.wkt
    pedestrian.jupedsim.wkt.geo pedestrian.jupedsim.py threads device.rerouting.threads device.rerouting.output
    verbose print-options xml-validation xml-validation.net xml-validation.routes no-warnings aggregate-warnings log
    message-log error-log log.timestamps log.processid language duration-log.disable duration-log.statistics
    no-step-log step-log.period phemlight-path device.ssm.file device.toc.file device.taxi.dispatch-algorithm.output
    device.taxi.idle-algorithm.output remote-port num-clients random seed gui-settings-file quit-on-end game
    game.mode start delay breakpoints edgedata-files alternative-net-file selection-file demo disable-textures
    registry-viewport window-size window-pos tracker-interval gui-testing gui-testing-debug
    gui-testing.setting-output
"""
IGNORED = frozenset(_IGNORED.split())
"""Options that write files, open ports, belong to the graphical interface or to messages, or are set by the run."""

_PASSED = """
    weight-attribute load-state.offset load-state.remove-vehicles junction-taz begin end step-length
    step-method.ballistic extrapolate-departpos lateral-resolution route-steps no-internal-links
    ignore-junction-blocker ignore-route-errors ignore-accidents collision.action intermodal-collision.action
    collision.stoptime intermodal-collision.stoptime collision.check-junctions collision.check-junctions.mingap
    collision.mingap-factor keep-after-arrival max-num-vehicles max-num-persons max-num-teleports scale scale-suffix
    time-to-teleport time-to-teleport.highways time-to-teleport.highways.min-speed time-to-teleport.disconnected
    time-to-teleport.remove time-to-teleport.remove-constraint time-to-teleport.ride time-to-teleport.bidi
    time-to-teleport.railsignal-deadlock waiting-time-memory startup-wait-threshold max-depart-delay sloppy-insert
    eager-insert emergency-insert insertion-checks random-depart-offset lanechange.duration
    lanechange.overtake-right tls.all-off tls.actuated.show-detectors tls.actuated.jam-threshold
    tls.actuated.detector-length tls.delay_based.detector-range tls.yellow.min-decel railsignal-moving-block
    railsignal.moving-block.default-classes railsignal.moving-block.max-dist railsignal.max-block-length
    railsignal.default-classes slope-centered time-to-impatience default.departspeed default.departlane
    default.action-step-length default.carfollowmodel default.speeddev default.emergencydecel overhead-wire.solver
    overhead-wire.recuperation overhead-wire.substation-current-limits emergencydecel.warning-threshold
    parking.maneuver use-stop-ended use-stop-started pedestrian.model pedestrian.timegap-crossing
    pedestrian.striping.stripe-width pedestrian.striping.dawdling pedestrian.striping.mingap-to-vehicle
    pedestrian.striping.jamtime pedestrian.striping.jamtime.crossing pedestrian.striping.jamtime.narrow
    pedestrian.striping.jamfactor pedestrian.striping.reserve-oncoming
    pedestrian.striping.reserve-oncoming.junctions pedestrian.striping.reserve-oncoming.max
    pedestrian.striping.legacy-departposlat pedestrian.striping.walkingarea-detail pedestrian.jupedsim.step-length
    pedestrian.jupedsim.exit-tolerance pedestrian.jupedsim.model pedestrian.jupedsim.strength-neighbor-repulsion
    pedestrian.jupedsim.range-neighbor-repulsion pedestrian.jupedsim.strength-geometry-repulsion
    pedestrian.jupedsim.range-geometry-repulsion ride.stop-tolerance mapmatch.distance mapmatch.junctions
    mapmatch.taz weights.turnaround-penalty weights.reversal-penalty persontrip.walk-opposite-factor
    routing-algorithm weights.random-factor weights.random-factor.dynamic weights.minor-penalty weights.tls-penalty
    weights.priority-factor weights.separate-turns persontrip.walkfactor persontrip.transfer.car-walk
    persontrip.transfer.taxi-walk persontrip.transfer.walk-taxi persontrip.default.group
    persontrip.taxi.waiting-time persontrip.ride-public-line railway.max-train-length replay-rerouting
    device.rerouting.probability device.rerouting.explicit device.rerouting.deterministic device.rerouting.period
    device.rerouting.pre-period device.rerouting.adaptation-weight device.rerouting.adaptation-steps
    device.rerouting.adaptation-interval device.rerouting.cch-update-threshold.factor
    device.rerouting.cch-update-threshold.constant device.rerouting.cch-ensemble device.rerouting.threshold.factor
    device.rerouting.threshold.constant device.rerouting.invalidation device.rerouting.with-taz
    device.rerouting.mode device.rerouting.init-with-loaded-weights device.rerouting.synchronize
    device.rerouting.railsignal device.rerouting.bike-speeds person-device.rerouting.probability
    person-device.rerouting.explicit person-device.rerouting.deterministic person-device.rerouting.period
    person-device.rerouting.mode person-device.rerouting.scope emissions.volumetric-fuel phemlight-year
    phemlight-temperature device.emissions.probability device.emissions.explicit device.emissions.deterministic
    device.emissions.begin device.emissions.period device.btreceiver.probability device.btreceiver.explicit
    device.btreceiver.deterministic device.btreceiver.range device.btreceiver.all-recognitions
    device.btreceiver.offtime device.btsender.probability device.btsender.explicit device.btsender.deterministic
    person-device.btsender.probability person-device.btsender.explicit person-device.btsender.deterministic
    person-device.btreceiver.probability person-device.btreceiver.explicit person-device.btreceiver.deterministic
    device.stationfinder.probability device.stationfinder.explicit device.stationfinder.deterministic
    device.stationfinder.rescueTime device.stationfinder.rescueAction device.stationfinder.reserveFactor
    device.stationfinder.emptyThreshold device.stationfinder.radius device.stationfinder.maxEuclideanDistance
    device.stationfinder.repeat device.stationfinder.chargeType device.stationfinder.waitForCharge
    device.stationfinder.minOpportunityDuration device.stationfinder.saturatedChargeLevel
    device.stationfinder.needToChargeLevel device.stationfinder.opportunisticChargeLevel
    device.stationfinder.replacePlannedStop device.stationfinder.maxDistanceToReplacedStop
    device.stationfinder.chargingStrategy device.stationfinder.checkEnergyForRoute device.battery.probability
    device.battery.explicit device.battery.deterministic device.battery.track-fuel device.example.probability
    device.example.explicit device.example.deterministic device.example.parameter device.ssm.probability
    device.ssm.explicit device.ssm.deterministic device.ssm.measures device.ssm.thresholds device.ssm.trajectories
    device.ssm.range device.ssm.extratime device.ssm.mdrac.prt device.ssm.geo device.ssm.write-positions
    device.ssm.write-lane-positions device.ssm.write-na device.ssm.exclude-conflict-types device.toc.probability
    device.toc.explicit device.toc.deterministic device.toc.manualType device.toc.automatedType
    device.toc.responseTime device.toc.recoveryRate device.toc.lcAbstinence device.toc.initialAwareness
    device.toc.mrmDecel device.toc.dynamicToCThreshold device.toc.dynamicMRMProbability device.toc.mrmKeepRight
    device.toc.mrmSafeSpot device.toc.mrmSafeSpotDuration device.toc.maxPreparationAccel device.toc.ogNewTimeHeadway
    device.toc.ogNewSpaceHeadway device.toc.ogMaxDecel device.toc.ogChangeRate device.toc.useColorScheme
    device.driverstate.probability device.driverstate.explicit device.driverstate.deterministic
    device.driverstate.initialAwareness device.driverstate.errorTimeScaleCoefficient
    device.driverstate.errorNoiseIntensityCoefficient device.driverstate.speedDifferenceErrorCoefficient
    device.driverstate.headwayErrorCoefficient device.driverstate.freeSpeedErrorCoefficient
    device.driverstate.speedDifferenceChangePerceptionThreshold device.driverstate.headwayChangePerceptionThreshold
    device.driverstate.minAwareness device.driverstate.maximalReactionTime device.bluelight.probability
    device.bluelight.explicit device.bluelight.deterministic device.bluelight.reactiondist
    device.bluelight.mingapfactor device.fcd.probability device.fcd.explicit device.fcd.deterministic
    device.fcd.begin device.fcd.period device.fcd.radius person-device.fcd.probability person-device.fcd.explicit
    person-device.fcd.deterministic person-device.fcd.period device.elechybrid.probability
    device.elechybrid.explicit device.elechybrid.deterministic device.taxi.probability device.taxi.explicit
    device.taxi.deterministic device.taxi.dispatch-algorithm device.taxi.dispatch-algorithm.params
    device.taxi.dispatch-period device.taxi.dispatch-keep-unreachable device.taxi.idle-algorithm
    device.taxi.vclasses device.glosa.probability device.glosa.explicit device.glosa.deterministic
    device.glosa.range device.glosa.max-speedfactor device.glosa.min-speed device.glosa.add-switchtime
    device.glosa.use-queue device.glosa.override-safety device.glosa.ignore-cfmodel device.tripinfo.probability
    device.tripinfo.explicit device.tripinfo.deterministic device.vehroute.probability device.vehroute.explicit
    device.vehroute.deterministic device.friction.probability device.friction.explicit device.friction.deterministic
    device.friction.stdDev device.friction.offset device.fcd-replay.probability device.fcd-replay.explicit
    device.fcd-replay.deterministic device.fcd-replay.consistency mesosim meso-ltm meso-edgelength meso-tauff
    meso-taufj meso-taujf meso-taujj meso-jam-threshold meso-multi-queue meso-lane-queue meso-ignore-lanes-by-vclass
    meso-junction-control meso-junction-control.limited meso-tls-penalty meso-tls-flow-penalty meso-minor-penalty
    meso-overtaking meso-recheck meso-interpolate-pos thread-rngs
"""
PASSED = frozenset(_PASSED.split())
"""Options that change the traffic only."""

SYNONYMS = {
    "net": "net-file", "n": "net-file", "routes": "route-files", "r": "route-files", "additional": "additional-files",
    "a": "additional-files", "weights": "weight-files", "w": "weight-files", "measure": "weight-attribute",
    "x": "weight-attribute", "b": "begin", "e": "end", "srand": "seed", "abs-rand": "random", "ndump": "netstate-dump",
    "netstate": "netstate-dump", "netstate-output": "netstate-dump", "summary": "summary-output",
    "tripinfo": "tripinfo-output", "personinfo": "personinfo-output", "vehroutes": "vehroute-output",
    "personroutes": "personroute-output", "statistics-output": "statistic-output", "person-fcd": "person-fcd-output",
    "log-file": "log", "l": "log", "v": "verbose", "p": "print-options", "W": "no-warnings",
    "suppress-warnings": "no-warnings", "X": "xml-validation", "C": "save-configuration", "c": "configuration-file",
    "H": "human-readable-time", "g": "gui-settings-file", "S": "start", "Q": "quit-on-end", "G": "game", "d": "delay",
    "B": "breakpoints", "m": "edgedata-files", "N": "alternative-net-file", "D": "demo", "T": "disable-textures",
    "device.routing.period": "device.rerouting.period", "device.routing.pre-period": "device.rerouting.pre-period",
    "device.rerouting.knownveh": "device.rerouting.explicit", "device.emissions.knownveh": "device.emissions.explicit",
    "device.btreceiver.knownveh": "device.btreceiver.explicit", "device.btsender.knownveh": "device.btsender.explicit",
    "device.fcd.knownveh": "device.fcd.explicit", "carfollow.model": "default.carfollowmodel",
    "no-duration-log": "duration-log.disable",
}  # fmt: skip
"""Other names that SUMO accepts."""
