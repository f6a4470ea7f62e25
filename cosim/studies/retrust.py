"""Repeats a run with further trust variants, and checks that nothing else has changed."""

import hashlib
import json
from pathlib import Path

import pandas as pd

from cosim.base.durable import Damaged
from cosim.config.config import Config, of_run, resolve_data
from cosim.config.data import read_toml
from cosim.door.permission import loading_code_of
from cosim.runs import run as running
from cosim.runs.check import check
from cosim.runs.drive import Advance
from cosim.runs.inputs import provenance
from cosim.runs.stop import Failed
from results.archive import OpenRun, open_run
from results.verify import verify


def retrust(run: Path, file: Path, out: Path, advance: Advance, trust_code: bool = False) -> Path:
    """Repeat a run and add the trust variants of a file.

    Trust variants do not change traffic, sensing or messages. The repetition therefore has the tables of the run, with
    rows of the further variants added, as if the variants had been in its config from the beginning.

    Parameters
    ----------
    run
        Folder of a finished run.
    file
        TOML file with `[[trust_variant]]` sections. The user's own classes that it names are loaded, unless the file is
        part of a run or a study.
    out
        Folder to write.
    advance
        Called with progress.
    trust_code
        Also load the classes that the run's config names, and those of a file that is part of a run or a study.

    Returns
    -------
    The folder `out`.

    Raises
    ------
    ValueError
        In one line, if the variants do not fit the run, or the inputs of the run have changed.
    Damaged
        If the files of the run are not those that were written.
    Failed
        If the repetition differs from the run. The folder `out` is then kept: it is a whole run of its own.
    """
    before = open_run(run)
    config = _with_variants(before, file, trust_code)
    now, then = provenance(config, check(config)), before.manifest["net"]
    if changed := sorted(key for key in now.keys() | then.keys() if now.get(key) != then.get(key)):
        raise ValueError(f"{run}: its inputs have changed since: {', '.join(changed)}. Run again with the variants.")
    if problems := verify(run)[1]:
        raise Damaged(f"{run} is damaged: {problems[0]}. Run again.")
    after = open_run(running.run(config, out, advance))
    for table in before.tables:
        if _digest(before, table, before.variants) != _digest(after, table, before.variants):
            raise Failed(
                f"{out}: table {table} differs from that of {run}, which another version of cosim or of its libraries "
                f"wrote. {out} is a whole run: compare its variants with one another, not with {run}."
            )
    return out


def _with_variants(run: OpenRun, file: Path, trust_code: bool) -> Config:
    """The run's config with further trust variants."""
    of_run(run.config, run.path, trust_code)  # refuses code that the folder names
    stated = read_toml(file, "file of trust variants")
    listed = stated.pop("trust_variant", [])
    if stated or not listed:
        raise ValueError(f"{file}: sections [[trust_variant]] are wanted, and nothing else.")
    data = json.loads(json.dumps(run.config))
    data["trust_variant"] = [*data.get("trust_variant", []), *listed]
    with loading_code_of(file, trust_code):
        return resolve_data(data, str(file), file.parent)


def _digest(run: OpenRun, table: str, variants: tuple[str, ...]) -> bytes:
    """A digest of the rows of a table that belong to these variants; it does not depend on the blocks."""
    digest = hashlib.sha256()
    for rows in run.parts(table):
        if "variant" in rows:
            rows = rows[rows.variant.isin(variants)]
        digest.update(pd.util.hash_pandas_object(rows, index=False).to_numpy().tobytes())
    return digest.digest()
