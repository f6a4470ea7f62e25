"""Whose code a file may name: what it is part of, at any depth, and whatever was taken out of the folder."""

import os

import pytest

from cosim.config.config import load
from cosim.door.permission import CodeNotTrusted, part_of
from cosim.studies import study
from cosim.studies.points import points_of

CODE = "class Trap:\n    pass\n"
CONFIG = '[trust]\nmodel = "trap.py:Trap"\n'
STUDY = '[study]\nname = "s"\n[grid]\n"trust.freshness_s" = [5.0]\n'


@pytest.fixture
def run(tmp_path):
    """What is left of a run folder with code in its config."""
    folder = tmp_path / "runs" / "mine"
    (folder / "again").mkdir(parents=True)
    (folder / "manifest.json").write_text("{}")
    for place in (folder, folder / "again"):
        (place / "config.toml").write_text(CONFIG)
        (place / "trap.py").write_text(CODE)
    return folder


def link(place, to):
    place.symlink_to(to)
    return place


def test_what_a_file_is_part_of(run, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("")
    assert part_of(run / "config.toml") == part_of(run / "again" / "config.toml") == run
    assert part_of(mine) is None and part_of(run / ".." / ".." / "mine.toml") is None
    assert part_of(link(tmp_path / "one.toml", "runs/mine/config.toml")) == run
    assert part_of(link(tmp_path / "two.toml", "one.toml")) == run, "a link to a link"
    assert part_of(link(run / "three.toml", "../../mine.toml")) == run, "the folder's author chose where it leads"
    assert part_of(link(tmp_path / "four.toml", "runs/mine/three.toml")) == run


@pytest.mark.parametrize("mark", ["manifest.json", "Manifest.JSON", "inventory.jsonl", "index.parquet"])
@pytest.mark.parametrize("make", ["file", "folder", "nowhere"])
def test_whatever_has_a_name_of_a_run(tmp_path, mark, make):
    if make == "nowhere":
        (tmp_path / mark).symlink_to("/nowhere/at/all")
    elif make == "folder":
        (tmp_path / mark).mkdir()
    else:
        (tmp_path / mark).write_text("")
    assert part_of(tmp_path / "a" / "b.toml") == tmp_path


def test_studies_without_their_index_and_folders_that_are_none(tmp_path):
    (tmp_path / "study" / "runs" / "0123456789abcdef").mkdir(parents=True)
    (tmp_path / "jobs_of_mine").mkdir()
    (tmp_path / "runs" / "helsinki-1").mkdir(parents=True)  # what `cosim run` writes beside the user's own files
    (tmp_path / "jobs").mkdir()
    assert part_of(tmp_path / "study" / "study.toml") == tmp_path / "study"
    assert part_of(tmp_path / "study.toml") is None


def refused(load_it):
    with pytest.raises(CodeNotTrusted, match="It was not loaded"):
        load_it()


def test_every_way_to_name_the_code_of_a_folder_is_refused(run, tmp_path):
    for number, place in enumerate((run, run / "again")):
        refused(lambda place=place: load(place / "config.toml"))
        own = tmp_path / f"own-{number}.toml"
        own.write_text(STUDY.replace("[grid]", f'config = "{place}/config.toml"\n[grid]'))
        refused(lambda own=own: study.load(own))
    beside = run / "study.toml"
    beside.write_text(STUDY + '"trust.model" = ["trap.py:Trap"]\n')
    refused(lambda: points_of(study.load(beside), "study.toml"))
    beside.write_text(STUDY + '[measure]\nown = "trap.py:trap"\n')
    refused(lambda: study.load(beside))


def test_the_permission_and_the_users_own_file(run, tmp_path):
    """Both load the file, which then turns out to hold no trust model."""
    with pytest.raises(ValueError, match="Trap has no method"):
        load(run / "config.toml", trust_code=True)
    (tmp_path / "mine.toml").write_text(CONFIG)
    (tmp_path / "trap.py").write_text(CODE)
    os.link(tmp_path / "mine.toml", tmp_path / "same.toml")
    for name in ("mine.toml", "same.toml"):
        with pytest.raises(ValueError, match="Trap has no method"):
            load(tmp_path / name)
