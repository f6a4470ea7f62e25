"""CSV for spreadsheets: text is never a formula, numbers stay numbers."""

import pandas as pd

from results.spreadsheet import csv_of


def test_text_cells_are_protected_and_numbers_are_not():
    frame = pd.DataFrame({
        "sumo_id": ["=cmd|'/c calc'!A1", "+1+1", "-2", "@SUM(A1)", "car", "\tx", None], "=x": [-1.5] * 7,
        "role": pd.Categorical(["-honest", *["malicious"] * 6]),
    })  # fmt: skip
    lines = csv_of(frame).decode().splitlines()
    assert lines[0] == "sumo_id,'=x,role"
    assert [line.partition(",-1.5")[0] for line in lines[1:]] == [
        "'=cmd|'/c calc'!A1", "'+1+1", "-2", "'@SUM(A1)", "car", "'\tx", "",
    ]  # fmt: skip
    assert lines[1].endswith(",'-honest") and lines[2].endswith(",malicious")
