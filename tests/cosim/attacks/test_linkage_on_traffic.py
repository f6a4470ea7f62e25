"""Linkage in a city: with a linking server nothing but names tells a run with changing pseudonyms from one without."""

import pandas as pd
import pytest

from cosim.attacks.catalogue import ATTACKS
from results.archive import open_run
from tests.cosim.attacks.test_linkage import NAMED
from tests.drive import simulate
from tests.fingerprint import fingerprint

KEYS = ("traffic.duration_s=20", "traffic.warmup_s=100", "fleet.penetration_p=0.4")
GHOSTS = """[[attacks]]
attack = "ghost_insertion"
share_p = 0.2
start_s = 4
"""
POLICIES = {
    "periodical": "period_s=5", "disposable": "n_messages=4", "distance": "distance_m=40", "random": "change_p=0.3"
}  # fmt: skip
BY_VEHICLE = {("fused", "observer"), ("observability", "observer")}
"""Columns of such names that hold vehicles."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("linkage")

    def made(name, text, *keys):
        (folder / f"{name}.toml").write_text(text)
        return simulate(folder / name, *KEYS, *keys, config=folder / f"{name}.toml")

    return made


def with_vehicles(path):
    """All tables with vehicles in the place of their pseudonyms, in one order."""
    found = open_run(path)
    names = found.pseudonyms.set_index("pseudonym").vehicle
    tables = {}
    for name in found.tables:
        if name == "pseudonyms" or not found.n_blocks(name):
            continue
        rows = found.table(name)
        for column in NAMED & set(rows.columns):
            if (name, column) not in BY_VEHICLE:
                rows[column] = rows[column].map(names)
        tables[name] = rows.sort_values(list(rows.columns), kind="stable").reset_index(drop=True)
    return tables, found.pseudonyms.groupby("vehicle").size().mean()


@pytest.mark.verify
def test_linkage_at_the_server_equals_no_policy_but_for_names(run):
    """Every table, over a channel with collisions and a cellular link with losses, of 37 vehicles in 20 s."""
    constant, _ = with_vehicles(run("constant", GHOSTS))
    assert len(constant["fused"]) > 1000 and len(constant["evaluations"]) > 1000
    for policy, key in POLICIES.items():
        keys = [f"pseudonyms.{k}" for k in (f"policy={policy}", key, "linkage=server")]
        found, n_names = with_vehicles(run(policy, GHOSTS, *keys))
        assert n_names > 2 and found.keys() == constant.keys()
        for name in constant:
            pd.testing.assert_frame_equal(found[name], constant[name], check_exact=True, check_dtype=False)
        print(f"{policy}: {n_names:.1f} pseudonyms per vehicle, {len(constant)} tables equal")


@pytest.mark.verify
def test_attacks_that_nobody_carries_out_leave_every_table_alone(run):
    """Each of the library, with share 0 and a time that has come, all in one run, beside a run without attacks."""
    every = "\n".join(f'[[attacks]]\nattack = "{name}"\nshare_p = 0.0\nstart_s = 0' for name in ATTACKS)
    assert fingerprint(run("nobody", every)) == fingerprint(run("none", "attacks = []"))
