"""All metrics of nine runs of three cities, central and local trust, against a script that shares no code."""

import pytest

from tests.drive import drive
from tests.verification import recompute_metrics

RUNS = {
    "helsinki": ("record.level=full", "trust_variant.0.name=beta", "trust_variant.0.model=beta"),
    "helsinki, server every second": ("trust.server_period_s=1.0", "seed=2"),
    "helsinki, local": ("trust.host=local", "attacks.0.start_s=3", "trust.suspect_from=5"),
    "koenigs-wusterhausen, local, pseudonyms": (
        "traffic.scenario=koenigs-wusterhausen", "trust.host=local", "traffic.step_s=0.5", "pseudonyms.policy=c2c",
        "driver.model=cautious",
    ),
    "helsinki, messages as standardised": (
        "traffic.step_s=0.5", "cpm.rules=etsi", "cpm.length=uper", "cpm.redundancy=dynamics", "cpm.max_objects=3",
    ),
    "helsinki, vehicles that sense at different times": ("preset=modern", "record.level=full", "traffic.step_s=0.2"),
    "helsinki, roadside units, groups and generation rules": (
        "preset=modern", "roadside=[{junctions=3, trusted=false}]", "sensing_interval_s=0.4", "cpm.rules=etsi",
        "sensing_groups=[{share_p=0.3, interval_s=1.2}]",
    ),
    "helsinki, local, pseudonyms and random phases": (
        "preset=modern", "trust.host=local", "pseudonyms.policy=disposable", "pseudonyms.n_messages=4",
        "roadside=[{junctions=3}]",
    ),
    "adlershof, encounters with pedestrians": (
        "traffic.scenario=adlershof", "seed=3", "encounters.0.pairs=all", "encounters.0.pedestrians=true",
    ),
}  # fmt: skip


@pytest.mark.verify
@pytest.mark.parametrize("name", RUNS)
def test_every_metric_is_what_its_definition_says(name, tmp_path):
    folder = drive(tmp_path / "run", *RUNS[name])
    for variant in ("base", "beta") if "beta" in str(RUNS[name]) else ("base",):
        n, found = recompute_metrics.differences(folder, variant)
        assert n > 150 and not found, found
