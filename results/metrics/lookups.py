"""What vehicles look up of trust, as arrays: the largest table of a run, which many metrics go through."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from results.run import Run

_IN_MEMORY = 2_000_000
"""Rows of `trust_lookups` up to which they are read once for all metrics."""
_ASKED = (
    "step", "receiver", "subject", "state", "trust", "age_s", "newest_evaluation_age_s", "oldest_evaluation_age_s",
    "n_evaluations", "n_evaluators",
)  # fmt: skip

NO_LOOKUPS = (
    "holds no trust lookups: no message was received. Raise radio.range_m or fleet.penetration_p, and run again."
)


def blocks(run: Run, columns: Sequence[str], may_be_none: bool = False) -> Iterator[Mapping[str, ndarray]]:
    """Lookups of the run's variant, block of steps by block, as of `Run.variant_arrays`.

    Besides the columns of the table there is `role`, of `role_codes`. ValueError where there are no lookups, unless
    there may be none.
    """
    if run.n_rows("trust_lookups") // len(run.variants) > _IN_MEMORY:
        found = _read(run, [column for column in columns if column != "role"] + ["subject"])
    else:
        found = iter(run.once("lookups", lambda: list(_read(run, _ASKED))))
    n_rows = 0
    for block in found:
        n_rows += len(block["subject"])
        yield block
    if not n_rows and not may_be_none:
        raise ValueError(f"{run.path} {NO_LOOKUPS}")


def _read(run: Run, columns: Sequence[str]) -> Iterator[Mapping[str, ndarray]]:
    for block in run.variant_arrays("trust_lookups", list(dict.fromkeys(columns))):
        yield block | {"role": role_codes(run, block["subject"])}


def role_codes(run: Run, pseudonym: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Code of the role of the vehicle behind each pseudonym, in the order of `Run.role_labels`."""
    known, code = run.once_for_all("roles by pseudonym", lambda: _roles(run))
    return code[np.searchsorted(known, pseudonym)]


def _roles(run: Run) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    role = run.subjects.role.sort_index()
    return role.index.to_numpy(), role.cat.codes.to_numpy(np.int64)
