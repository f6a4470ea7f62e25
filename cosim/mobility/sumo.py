# Changelog

What changed for users, newest first. "Numbers change" says where results move.

## Unreleased

### Added
- A run folder is a unit: created for one run alone, locked while written, with checksums of every part, block and
  manifest; `cosim verify`. `cosim resume` continues a run that was stopped or killed from its last whole block, to the
  tables of a run never interrupted. SIGTERM and SIGINT stop at the next step with everything written (exit status 143,
  130). `measure`, `plot` and `report` show unfinished runs as far as they are whole, say so, and end with exit status 1
  where damage leaves a figure out. Parts of open encounters, vehicles and pseudonyms with every block.
- Table `dropped_detections`: what no message can hold is dropped before it is sent, and counted by cause.
- `tests/hostile/`: configs from the schema, damaged folders, kills; counts printed, cases kept.
- Belief moves traffic: `driver.model = "cautious"` brakes for objects in its lane path that others report and its own
  detector does not, as behind a virtual leader; drivers behind react by SUMO's car following. Table `reactions`. Steps of
  0.5 s or less; replayed traffic refuses it. A driver of one's own is called in every step, with `beliefs = None` between
  two sweeps, and finds lane paths in `world.paths`.
- Metrics have stable identifiers (`trust.final.median`) with label, unit and definition: `cosim measure --explain`,
  `--json`, `run.measure.value(...)`, the report; what a metric is split by is its `group`. `results/TABLES.md` describes
  words, tables and metrics.
- Trust variants (column `variant`) and roles of a run's own in the tables; table `pseudonyms`; `trust.uncertainty`.
- The house: `sensors`, `trust`, `results`, `sumo_nets` and the hall `cosim`, with a test that guards the doors.
- Central Helsinki as a shipped city with demand for an ordinary afternoon.
- `cosim run | check | measure | plot | report | nets list | bench`.
- `cosim nets build` makes a city from an OpenStreetMap file or box; `cosim nets show` describes and draws one;
  `adlershof`, `braunschweig` and `koenigs-wusterhausen` from SUMO's own package by name.
- Any `.sumocfg` as `traffic.scenario`: nothing is written beside it, whatever is not on the road is left out and counted, a
  run that outlives its traffic ends and says so. `traffic.begin_s` and `traffic.scale`.
- Traces (SUMO's FCD as XML, CSV or Parquet) and earlier runs as traffic, with the tables of the live run.
- Radio: roadside units (`rsu.at`, `rsu.n_at_junctions`); the trust server through them or through a cellular network with
  second attempts and full cells (`server.uplink`, `server.cellular`); `server.outages`; generation rules
  (`radio.cpm_rules = "etsi"`); `radio.verdicts = "piggybacked"`. Tables `latencies`, `silences`, `ears` and `server`;
  delivery by what stands between; `cosim plot radio` with latency, inter-reception time and maps; `cosim measure` says
  under what conditions the radio's figures hold.

- `cosim reproduce scenario-1 | scenario-2`: the paper's scenes through the real pipeline; `adversary.victim`.
- LiDAR: tractors with trailers, articulated buses, meshes, roadside posts; Open3D as a third engine (extra `open3d`);
  `cosim plot sweep` draws a cloud again, or writes it as .ply, .pcd, .bin, .npy; `python -m cosim.calibrate`.
- Relays by flat probability (`radio.relay.rule`).
- Trust models behind one interface (`trust.model`): `trupercept` and `beta`; `trust.freshness_s = "off"` with
  `trust.grace_s`; variants of `trupercept` share their evidence.
- `cosim plot freshness --over KEY` holds several runs against the number in which they differ.
- `cosim plot liars`, `cosim measure --false-positives`, `run.measure.liars`: ROC curve and its area, true positives and
  time until suspected at a fixed share of false positives, false alarms among honest vehicles.
- False boxes cling to places (`detector.clutter_memory_s`, `clutter_memory_share`, `clutter_shared`), and may be any
  number per sweep. Profiles state where each published figure is from.
- `cosim nets build --overpass | --left-hand`; what `--bbox` fetched is kept. `cosim nets list` fills every cell.
- Polygons in any additional file, also in longitudes and latitudes, become buildings, and stand on the hill that the
  streets climb. Errors after which SUMO goes on are told.
- Trust variants have rows of their own in the table `server`, and their trust at encounters in the new table
  `encounter_trust`: a variant's tables are those of a run of its own, value for value (schema version 5).
- `cosim sweep STUDY.toml --out DIR`: studies. Points that differ in trust alone are trust variants of one run, runs of the
  same traffic replay it; `--dry-run`, `--scheduler`, `--workers`; `cosim status`, `cosim cache`. `cosim measure`, `plot` and
  `report` take a study: means with 95 % intervals, paired differences against a baseline, swept keys on axis and colour.
  In Python `results.study.open_study`. New dependencies: Dask's `distributed`, `psutil`.

### Changed
- Every number of the config has bounds, those inside lists too; what is outside is refused in one line. At most 255
  objects in a message. Schema version 6: `summary.detections_malformed` is `summary.detections_dropped`, by cause.
- `trust.where` is `trust.host`, and `trust.local_evidence = "heard"` is `"received"`. `trust.certify_own_lies` is gone: what a
  malicious vehicle reports of its own detections is the attack's business. The manifest's `unknown_vehicle` among rejected
  evaluations is `unknown_observer`.
- Schema version 4: tables, columns and metrics carry the field's words (`uses` is `trust_lookups`,
  `verdicts` is `evaluations`, `behaviour` is `role`, ...). Observers, evaluators and subjects are pseudonyms. `encounters`
  has its `hysteresis_s` in the key, so that definitions which differ in it alone no longer collide. Run folders of a
  former schema are refused with one line. `cosim plot liars` is `cosim plot misbehaviour`.
- The summary at the end of a run fits on 15 lines. Malicious is red in every picture.
- A `.sumocfg` keeps its own step-length where `traffic.step_s` is not set; it was 1 s.
- `random`, threads and `remote-port` of a `.sumocfg` are overruled.
- Figures about liars are a topic of their own, `liars`, no longer `trust`. `Run` is in `results.run`; `open_run` stays in
  `results.archive`.
- Judging and fusing cost a quarter of what they did, recording a third: a turn of 950 equipped vehicles in Bologna's
  rush hour takes half a second where it took 1.3.
- Relays are events in the channel's loop, exact to the nanosecond, no longer cut into windows of 2 ms: 3 hops among 62
  radios cost 3.5 ms per round instead of 71. A round of messages takes about half the time, the second of a turn a fifth.
- `cosim bench v2x` shows whole rounds and relays beside the network step, in processor time.
- `compute.threads = 0` takes one thread for every hundred equipped vehicles, not all cores: small runs side by side no
  longer wait for one another.
- `server.delay_min_s` and its kin are now in `[server.cellular]`. Schema version 3: runs of earlier versions are run again.

### Numbers change
- Adlershof and Braunschweig come without railways, with more gates. Towns built from OpenStreetMap: heights of 38 more
  kinds of building. Scenarios with elevation: buildings no longer stand at z = 0; heights pass through single precision.
- All false boxes are new ones; how many, and their scores, are as before, but those at far walls are a little rarer. AP
  moves by 0.2 points at most, final mean trust by 0.003.
- Runs with relays move by about 1 %; runs with one hop do not move.
- `propagation.walls = "sommer"`: losses no longer depend on which end is asked where an antenna stands exactly on a wall.
- A vehicle is suspected only by trust that rests on a verdict, while it is on the road; the 0 of a vehicle that nobody
  could see no longer counts as found out.
- Poses are rounded to 1/256 m and 1/512 rad, and speeds to 1/256 m/s, as the table `actors` keeps them, before anybody
  senses; newcomers of a step are numbered by name, vehicles first.
- A cellular report that fails is tried twice more: 1 in a million is lost, not 1 in a hundred.
- Detections: the `avod` profile is calibrated, luck lasts for some seconds per observer and actor, doubles and confused
  classes occur, clutter lies along walls. `detector.clutter_lwh_m` is now `detector.mean_lwh_m`.
