"""Writing runs: what is refused, what survives a crash, what a fingerprint sees."""

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from results.archive import open_run
from results.recorder import Recorder
from results.tables import TABLES
from tests.fingerprint import fingerprint
from tests.results.synthetic import write


def trust_of(subject, trust):
    n = len(subject)
    return {
        "variant": np.zeros(n, int), "subject": np.array(subject), "trust": np.array(trust, float),
        "uncertainty": None, "weight": np.ones(n),
        "state": np.zeros(n, int), "n_evaluations": np.ones(n, int), "n_evaluators": None,
        "newest_evaluation_age_s": np.zeros(n), "oldest_evaluation_age_s": None,
    }  # fmt: skip


def stored(folder, table):
    return pd.concat([pq.read_table(path).to_pandas() for path in sorted((folder / table).glob("*.parquet"))])


def test_round_trip(tmp_path):
    with Recorder(tmp_path, "summary", block_steps=2) as record:
        record.append("trust", 0, trust_of([7, 3], [0.25, 0.75]))
        record.append("trust", 5, trust_of([3], [0.5]))
    assert [path.name for path in sorted((tmp_path / "trust").iterdir())] == [
        "part-00000.parquet",
        "part-00002.parquet",
    ]
    frame = stored(tmp_path, "trust")
    assert frame.step.tolist() == [0, 0, 5]
    assert frame.subject.tolist() == [3, 7, 3]  # sorted by key
    assert frame.trust.tolist() == [0.75, 0.25, 0.5]
    assert frame.oldest_evaluation_age_s.isna().all() and not frame.newest_evaluation_age_s.isna().any()


@pytest.mark.parametrize(
    "change, complaint",
    [
        ({"trusst": np.ones(2)}, "unknown trusst"),
        ({"weight": None}, None),
        ({"trust": np.array([0.5, np.nan])}, "trust.trust holds something that is not a finite number"),
        ({"trust": np.ones(3)}, "trust.trust has shape"),
        ({"subject": np.array([1.0, 2.0])}, "whole numbers are wanted"),
        ({"subject": np.array([1, 2**31])}, "outside"),
        ({"subject": np.array([4, 4])}, "two rows with step = 0, variant = 0, subject = 4"),
        ({"newest_evaluation_age_s__valid": np.ones(1, bool)}, "trust.newest_evaluation_age_s has shape"),
        ({"weight__valid": np.array([True, False])}, "trust.weight cannot be null"),
    ],
)
def test_refuses(tmp_path, change, complaint):
    columns = trust_of([1, 2], [0.1, 0.2]) | change
    with pytest.raises(ValueError, match=complaint), Recorder(tmp_path, "summary") as record:
        record.append("trust", 0, columns)


def test_refuses_missing_columns_and_tables(tmp_path):
    with Recorder(tmp_path, "summary") as record:
        columns = trust_of([1], [0.1])
        del columns["trust"], columns["weight"]
        with pytest.raises(ValueError, match="missing trust, weight"):
            record.append("trust", 0, columns)
        with pytest.raises(ValueError, match="no table 'trusts'"):
            record.append("trusts", 0, columns)
        record.append("fused", 0, {"anything": np.ones(1)})  # not kept at this level: not looked at


def test_refuses_unknown_labels(tmp_path):
    row = {
        "variant": np.array(["base"]),
        "receiver": np.array([1]),
        "subject": np.array([2]),
        "trust": np.ones(1),
        "state": np.array([0]),
        "age_s": None,
        "n_evaluations": np.ones(1, int),
        "n_evaluators": None,
        "newest_evaluation_age_s": None,
        "oldest_evaluation_age_s": None,
    }
    with Recorder(tmp_path, "standard") as record:
        with pytest.raises(ValueError, match=r"trust_lookups.source = 'srver' is none of server, own, default"):
            record.append("trust_lookups", 0, row | {"source": np.array(["srver"])})
        record.append("trust_lookups", 0, row | {"source": np.array(["own"])})
        record.append("trust_lookups", 1, row | {"source": np.array([0])})
    assert stored(tmp_path, "trust_lookups").source.tolist() == ["own", "server"]
    (tmp_path / "again").mkdir()
    refused = pytest.raises(ValueError, match=r"trust_lookups.source holds 3 to 3, outside 0 to 2")
    with refused, Recorder(tmp_path / "again", "standard") as record:
        record.append("trust_lookups", 0, row | {"source": np.array([3])})


def test_a_callers_arrays_are_its_own(tmp_path):
    """What was appended is kept, whatever the caller does to its arrays, in a table of few rows and of many."""
    for n in (2, 10_000):
        (tmp_path / str(n)).mkdir()
        given = trust_of(np.arange(n), np.full(n, 0.5))
        with Recorder(tmp_path / str(n), "summary") as record:
            record.append("trust", 0, given)
            for column in given.values():
                if column is not None:
                    column[:] = 0
        frame = stored(tmp_path / str(n), "trust")
        assert frame.subject.tolist() == list(range(n)) and (frame.trust == 0.5).all()


def test_rounding_is_as_documented(tmp_path):
    """Positions are kept to 1/256 m, headings to 1/512 rad and never beyond pi."""
    x = np.random.default_rng(0).uniform(0, 9000, 100)
    with Recorder(tmp_path, "standard") as record:
        record.append("actors", 0, {
            "actor": np.arange(100), "x_m": x, "y_m": x, "z_m": x, "yaw_rad": np.full(100, np.pi), "speed_mps": x,
        })  # fmt: skip
    frame = stored(tmp_path, "actors")
    assert np.abs(frame.x_m - x).max() <= 1 / 512 + 2**-12
    assert (frame.yaw_rad <= np.pi).all()


def test_a_crash_loses_the_last_block_only(tmp_path):
    record = Recorder(tmp_path, "summary", block_steps=10)
    for step in range(25):
        record.append("trust", step, trust_of([1], [0.5]))
    del record  # never closed
    assert stored(tmp_path, "trust").step.max() == 19
    assert not list(tmp_path.rglob("*.partial"))


def test_resume_equals_a_run_in_one_go(tmp_path):
    def steps(folder, first, last, **options):
        with Recorder(folder, "summary", block_steps=10, **options) as record:
            for step in range(first, last):
                record.append("trust", step, trust_of([1, 2], [step / 100, 0.5]))

    whole, broken = tmp_path / "whole", tmp_path / "broken"
    whole.mkdir(), broken.mkdir()
    steps(whole, 0, 40)
    steps(broken, 0, 27)
    (broken / "trust" / "part-00002.partial").write_text("half a block")
    (broken / "trust" / "notes.txt").write_text("not ours")
    with pytest.raises(ValueError, match="Resume at step 20"):
        Recorder(broken, "summary", block_steps=10, resume_at=27)
    steps(broken, 20, 40, resume_at=20)
    assert fingerprint(broken) == fingerprint(whole)
    assert (broken / "trust" / "notes.txt").exists() and not list(broken.rglob("*.partial"))


def test_a_table_without_rows_is_read_as_parquet(tmp_path):
    """By pandas, and by file name: it has its columns, with their kinds, and no row."""
    run = open_run(write(tmp_path / "run", steps=20))
    empty = [name for name in run.tables if not len(run.table(name))]
    assert empty
    for name in empty:
        (file,) = (run.path / name).glob("part-*.parquet")
        alone = pq.ParquetFile(file).schema_arrow
        assert alone.names == list(TABLES[name].stored) and pq.ParquetFile(file).metadata.num_rows == 0
        assert list(pd.read_parquet(run.path / name)) == alone.names


def test_fingerprint_sees_one_bit(tmp_path):
    marks = []
    for i, value in enumerate((0.5, np.nextafter(np.float32(0.5), np.float32(1)))):
        folder = tmp_path / str(i)
        folder.mkdir()
        with Recorder(folder, "summary") as record:
            record.append("trust", 0, trust_of([1, 2], [0.25, value]))
        marks.append(fingerprint(folder)["trust"])
    assert marks[0] != marks[1]


def test_small_on_disk(run):
    """Below half a kilobyte per vehicle-second at standard (here every second vehicle talks)."""
    names = [name for name in TABLES if TABLES[name].level != "full"]
    size = sum(path.stat().st_size for name in names for path in (run.path / name).iterdir())
    assert size / len(run.actors) / run.dt_s < 500


def test_open_run_gives_what_was_written(tmp_path):
    path = write(tmp_path / "small", steps=30, level="standard")
    run = open_run(path)
    assert "receptions" not in run.tables and len(run.actors)
    assert run.actors.groupby("step").actor.is_monotonic_increasing.all()
