"""Questions in SQL: the same tables as `run.table`, and one line for a wrong question."""

import pickle
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
import pytest

from results.archive import open_run
from results.manifest import drop_tables
from tests.results.tiny import fleet

KEY = ["step", "variant", "observer", "fused_index"]


@pytest.mark.parametrize("name", ["fused", "encounters", "trust_lookups", "detections", "attack_outcomes", "clouds"])
def test_tables_are_those_of_the_run(run, name):
    """Columns that are not on disk too: those of `fused` are read from the detections that its rows name."""
    table, asked = run.table(name), run.sql(f"SELECT * FROM {name}")
    assert set(asked.columns) == set(table.columns) and len(asked) == len(table) == run.n_rows(name)
    for column in table.columns:
        one, other = (sorted(map(str, frame[column].dropna().tolist()))
                      for frame in (table, asked))  # fmt: skip
        assert one == other, column


def test_rows_of_fused_have_their_boxes(run):
    table = run.table("fused", [*KEY, "x_m", "yaw_rad", "class"]).astype({"variant": str, "class": str})
    asked = run.sql(f"SELECT {', '.join(KEY)}, x_m, yaw_rad, class FROM fused")
    pd.testing.assert_frame_equal(
        table.sort_values(KEY, ignore_index=True), asked.sort_values(KEY, ignore_index=True), check_dtype=False
    )


def test_values_and_subjects_by_hand(tiny):
    rows = [{"step": step, "subject": who, "trust": 0.25 * (who + 1)} for step in (0, 4) for who in (0, 1)]
    run = tiny(8, vehicles=fleet("honest", "malicious"), trust=rows)
    found = run.sql("""
        SELECT role, max(step) * $dt_s AS time_s, avg(trust) AS trust FROM trust JOIN subjects ON pseudonym = subject
        WHERE variant = $variant AND step < $until GROUP BY role ORDER BY role
    """, until=np.int64(5))  # fmt: skip
    assert found.role.tolist() == ["honest", "malicious"] and found.trust.tolist() == [0.25, 0.5]
    assert found.time_s.tolist() == [4 * run.dt_s] * 2


def test_of_some_steps_only_their_blocks_are_read(tiny):
    """Blocks have ten steps. A table without steps has all of its rows, and the next question sees all blocks again."""
    run = tiny(40, vehicles=fleet("honest"), trust=[{"step": step, "trust": 0.5} for step in range(0, 40, 5)])
    query = "SELECT step, $first AS first, $last AS last, (SELECT count(*) FROM vehicles) AS n FROM trust ORDER BY ALL"
    found = run.sql_of_steps(query, 12, 20)
    assert found.step.tolist() == [10, 15, 20, 25]
    assert found[["first", "last", "n"]].drop_duplicates().values.tolist() == [[12, 20, 1]]
    assert run.sql("SELECT count(*) AS n FROM TRUST").n.item() == 8  # 4 by the view of the question before
    assert run.sql_of_steps("SELECT * FROM trust", 40, 50).empty


def test_threads_share_a_run_and_processes_get_a_copy(tiny):
    run = tiny(20, vehicles=fleet("honest"), trust=[{"step": step, "trust": 0.5} for step in range(20)])
    query = "SELECT $who AS who, count(*) AS n FROM trust, generate_series(20000)"
    with ThreadPoolExecutor(3) as threads:
        found = threads.map(lambda who: run.sql(query, who=who), range(6))
    assert [tuple(frame.iloc[0]) for frame in found] == [(who, 20 * 20001) for who in range(6)]
    assert pickle.loads(pickle.dumps(run)).sql(query, who=0).n.item() == 20 * 20001


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ("SELECT speed FROM actors", 'column "speed" not found'),
        ("SELECT * FROM cars", "name cars does not exist! The tables are vehicles, pseudonyms"),
        ("SELEC 1", "syntax error"),
        ("SELECT 1; SELECT 2", "no single SELECT"),
        ("DROP VIEW vehicles", "no single SELECT"),
        ("COPY vehicles TO 'x.csv'", "no single SELECT"),
        ("INSTALL httpfs", "no single SELECT"),
        ("SELECT $speed", "speed"),
        ("SELECT * FROM read_csv('/etc/hostname')", "disabled by configuration"),
        ("SELECT * FROM read_parquet('https://example.org/x.parquet')", "disabled by configuration"),
    ],
)
def test_a_wrong_question_is_one_line(run, query, says):
    with pytest.raises(ValueError, match=" ") as error:
        run.sql(query)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_a_table_that_the_run_does_not_keep(run, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy)
    drop_tables(copy, ["receptions"])
    with pytest.raises(ValueError, match="holds no table receptions"):
        open_run(copy).sql("SELECT * FROM receptions")


def test_a_damaged_part_is_not_read(run, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy)
    part = next((copy / "trust").glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:-1] + b"x")
    with pytest.raises(ValueError, match="damaged"):
        open_run(copy).sql("SELECT count(*) FROM trust")
    assert len(open_run(copy).sql("SELECT * FROM vehicles"))


@pytest.mark.parametrize("name", ["ä b'c", "a\nb", "[a-b]*?", "'); x"])
def test_the_name_of_a_folder_is_a_name(run, tmp_path, name):
    """Its quotes do not end a string, and its stars and brackets stand for themselves: a neighbour is not read."""
    for folder in (tmp_path / name, tmp_path / "a_other"):
        shutil.copytree(run.path, folder)
    (tmp_path / "a_other" / "detections" / "part-00000.parquet").write_bytes(b"no table")
    same = open_run(tmp_path / name).sql("SELECT count(*) AS n FROM detections").n.item()
    assert same == run.n_rows("detections")
