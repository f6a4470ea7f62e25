"""Tables as labelled arrays: by hand, missing values, Zarr and back."""

import numpy as np
import pytest

from tests.results import tiny

xarray = pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    trust = [
        {"step": 2, "variant": "base", "subject": 5, "trust": 0.25, "state": "evaluated", "n_evaluations": 3,
         "newest_evaluation_age_s": 1.5},
        {"step": 2, "variant": "base", "subject": 9, "trust": 0.5, "state": "unevaluated"},
        {"step": 4, "variant": "base", "subject": 9, "trust": 1.0, "state": "evaluated", "n_evaluations": 1},
    ]  # fmt: skip
    folder = tmp_path_factory.mktemp("arrays") / "run"
    folder.mkdir()
    pseudonyms = [{"pseudonym": 5, "vehicle": 0, "to_step": 5}, {"pseudonym": 9, "vehicle": 1, "to_step": 5}]
    fleet = tiny.fleet("honest", "malicious")
    return tiny.make(folder, 6, vehicles=fleet, pseudonyms=pseudonyms, trust=trust)


def test_trust_by_hand(run):
    found = run.to_xarray("trust")
    assert dict(found.sizes) == {"time": 2, "subject": 2, "variant": 1}
    assert found.trust.dims == ("time", "subject", "variant")
    assert found.time.values.tolist() == [2.0, 4.0] and found.time.attrs["units"] == "s"
    assert float(found.trust.sel(time=2, subject=5, variant="base")) == 0.25
    assert np.isnan(found.trust.sel(time=4, subject=5, variant="base")), "there is no such row"
    assert found.newest_evaluation_age_s.attrs["units"] == "s" and found.trust.attrs["units"] == "1"
    meanings = found.state.attrs["flag_meanings"].split()
    assert meanings[int(found.state.sel(time=2, subject=9, variant="base"))] == "unevaluated"
    assert int(found.state.sel(time=4, subject=5, variant="base")) == -1
    assert all("long_name" in array.attrs for array in found.data_vars.values())


def test_some_columns(run):
    assert list(run.to_xarray("trust", ["trust"]).data_vars) == ["trust"]
    with pytest.raises(ValueError, match="has no column colour"):
        run.to_xarray("trust", ["colour"])


def test_a_table_without_steps(run):
    with pytest.raises(ValueError, match=r"one row for each vehicle, not one for each step\. Use run\.vehicles"):
        run.to_xarray("vehicles")


def test_every_row_is_in_its_place(run):
    found = run.to_xarray("trust")
    for row in run.trust.itertuples():
        assert float(found.trust.sel(time=row.step, subject=row.subject, variant=row.variant)) == row.trust
    assert int(found.trust.notnull().sum()) == len(run.trust)


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_zarr_and_back(run, tmp_path):
    pytest.importorskip("zarr")
    found = run.to_xarray("trust")
    found.to_zarr(tmp_path / "trust.zarr", zarr_format=2)
    again = xarray.open_zarr(tmp_path / "trust.zarr")
    assert again.trust.attrs == found.trust.attrs and again.sizes == found.sizes
    np.testing.assert_array_equal(again.trust.values, found.trust.values)
    assert again.coords["variant"].values.tolist() == ["base"]
