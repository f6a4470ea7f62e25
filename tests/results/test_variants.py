"""Trust variants and roles of a run's own: labels, pseudonyms, and metrics of one variant."""

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from cosim.base.codes import Role, labels
from results.archive import open_run
from results.figures import style
from results.manifest import finish
from results.recorder import Recorder
from tests.results.tiny import columns, fleet

VARIANTS, ROLES = ("base", "short_window"), (*labels(Role), "ghost")


@pytest.fixture
def run(tmp_path):
    """Vehicle 0 is honest, 1 a ghost that changes its pseudonym from 7 to 9 at step 3; the variant halves all trust."""
    vehicles = fleet("honest", "ghost", last_step=5)
    vehicles[1]["attack_start_step"] = 1
    pseudonyms = [
        {"pseudonym": p, "vehicle": v, "from_step": first, "to_step": last}
        for p, v, first, last in ((4, 0, 0, 5), (7, 1, 0, 2), (9, 1, 3, 5))
    ]
    trust = {2: {4: 0.8, 7: 0.4}, 4: {4: 0.6, 7: 0.2, 9: 0.5}}  # 7 is out of use at 4
    with Recorder(tmp_path, "standard", variants=VARIANTS, roles=ROLES) as record:
        for step, values in trust.items():
            for code, factor in enumerate((1.0, 0.5)):
                rows = [{"subject": p, "trust": factor * t, "n_evaluations": 1} for p, t in values.items()]
                named = {"step": np.full(len(rows), step), "variant": np.full(len(rows), code)}
                record.append("trust", step, columns("trust", rows) | named)
        record.append("pseudonyms", 5, columns("pseudonyms", pseudonyms))
        record.append("vehicles", 5, columns("vehicles", vehicles))
        met = {"a": 0, "b": 1, "start_step": 1, "trust_ab": 0.75}
        record.append("encounters", 5, columns("encounters", [met]))
        record.append(
            "encounter_trust", 5, columns("encounter_trust", [met | {"trust_ab": 0.25}]) | {"variant": np.ones(1, int)}
        )
        sensed = {"observer": 4, "detection_index": 1, "truth_actor": 1, "transmitted": True}
        record.append("detections", 5, columns("detections", [sensed]) | {"step": np.array([5])})
        believed = [{"observer": 0, "source": 4, "source_index": 1, "score": 0.5 + code / 4} for code in (0, 1)]
        record.append("fused", 5, columns("fused", believed) | {"step": np.full(2, 5), "variant": np.arange(2)})
    finish(tmp_path, {
        "dt_s": 1.0, "steps": 6, "config": {"trust": {}, "trust_variant": [{"name": "short_window"}]},
        "variants": VARIANTS, "roles": ROLES,
    })  # fmt: skip
    return open_run(tmp_path)


def test_roles_go_by_pseudonym(run):
    assert run.subjects.role.astype(str).to_dict() == {4: "honest", 7: "ghost", 9: "ghost"}
    assert run.subjects.vehicle.to_dict() == {4: 0, 7: 1, 9: 1}
    assert run.roles.astype(str).to_dict() == {0: "honest", 1: "ghost"}


def test_metrics_are_of_one_variant(run):
    """Last values while in use: 4 has 0.6, 7 has 0.4, 9 has 0.5; in the variant half of them."""
    assert run.variants == VARIANTS and len(run.trust) == 10
    for name, factor in zip(VARIANTS, (1, 0.5), strict=True):
        assert ("variant short_window" in repr(run.as_variant(name))) == (name != "base")
        final = run.as_variant(name).measure.trust.final().set_index("role")["mean"]
        assert final.to_dict() == pytest.approx({"honest": 0.6 * factor, "ghost": 0.45 * factor})
    assert run.measure.value("trust.final.mean", "ghost") == pytest.approx(0.45)
    assert np.isnan(run.measure.value("trust.final.mean", "malicious"))  # a role of the run, without a vehicle
    with pytest.raises(ValueError, match=r"no trust variant 'long'\. It has base, short_window"):
        run.as_variant("long")


def test_figures_of_all_variants_draw_each_once_and_a_chosen_one_alone(run):
    """With `--variant NAME` they drew all of them, and with `--variant all` each as often as there are variants."""
    chosen = run.as_variant("short_window")
    assert style.variants_of([run])[1] == style.variants_of([run, chosen])[1] == list(VARIANTS)
    assert style.variants_of([chosen])[1] == ["short_window"]


def test_columns_that_are_not_on_disk_can_choose_rows_of_one_variant(run):
    for name, score in zip(VARIANTS, (0.5, 0.75), strict=True):
        frame = run.as_variant(name).variant_table("fused", ["score"], pc.field("truth_actor") == 1)
        assert frame.score.tolist() == [score]


def test_encounters_have_the_trust_of_the_variant_however_they_are_read(run):
    """A condition chose by the trust of `base`, and parts had its columns."""
    for name, trust in zip(VARIANTS, (0.75, 0.25), strict=True):
        of_variant = run.as_variant(name)
        frames = of_variant.variant_table("encounters"), *of_variant.variant_parts("encounters", ["trust_ab"])
        assert [frame.trust_ab.tolist() for frame in frames] == [[trust]] * 2
        is_low = pc.field("trust_ab") < 0.5
        assert len(of_variant.variant_table("encounters", ["b"], is_low)) == (trust < 0.5)


def test_attackers_of_an_own_role_are_classified(run):
    """From step 1 on: honest 0.8, 0.6 above all of the ghost's 0.4 (as 7, until 2) and 0.5 (as 9, from 3)."""
    (row,) = run.measure.misbehaviour.classification().to_dict("records")
    assert (row["role"], row["n"], row["auc"]) == ("ghost", 2, 1.0)


def test_a_variant_costs_almost_nothing(run, tmp_path):
    (part,) = (tmp_path / "trust").iterdir()
    column = pq.ParquetFile(part).schema_arrow.field("variant")
    assert column.type.index_type.bit_width == 8 and column.type.value_type == "string"


def test_labels_are_checked(tmp_path):
    with pytest.raises(ValueError, match="variants = "):
        Recorder(tmp_path, "summary", variants=("base", "base"))
