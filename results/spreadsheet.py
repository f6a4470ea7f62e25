"""Tables as CSV in which a spreadsheet takes no cell of text for a formula."""

import pandas as pd

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""A spreadsheet takes text that begins with one of these for a formula (OWASP, CSV Injection)."""


def as_text(cell: object) -> object:
    """A cell. Text that a spreadsheet would compute gets an apostrophe in front, which marks it as text."""
    if not isinstance(cell, str) or not cell.startswith(_FORMULA):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def csv_of(frame: pd.DataFrame) -> bytes:
    """A table as CSV, without its index."""
    safe = frame.rename(columns=as_text)
    for name in safe.columns[[not pd.api.types.is_numeric_dtype(of) for of in safe.dtypes]]:
        safe[name] = safe[name].astype(object).map(as_text, na_action="ignore")
    return safe.to_csv(index=False, lineterminator="\n").encode()
