"""Files that are made new: what has their name is neither followed nor waited for."""

import os

import pytest

from cosim.base import durable


@pytest.mark.parametrize("make", ["file", "link", "nowhere", "hard link", "pipe"])
def test_a_new_file_takes_the_name_of_whatever_has_it(tmp_path, make):
    precious, path = tmp_path / "precious", tmp_path / "x.partial"
    precious.write_text("mine")
    ways = {
        "file": lambda: path.write_text("old"), "link": lambda: path.symlink_to(precious),
        "nowhere": lambda: path.symlink_to(tmp_path / "made"), "hard link": lambda: os.link(precious, path),
        "pipe": lambda: os.mkfifo(path),
    }  # fmt: skip
    ways[make]()
    with open(durable.new_file(path), "wb") as file:
        file.write(b"new")
    assert path.read_bytes() == b"new" and not path.is_symlink()
    assert precious.read_text() == "mine" and not (tmp_path / "made").exists()


def test_a_file_is_written_under_its_name(tmp_path):
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "a.partial").symlink_to(tmp_path / "precious")
    durable.write(tmp_path / "a", b"content")
    assert (tmp_path / "a").read_bytes() == b"content" and (tmp_path / "precious").read_text() == "mine"


def test_below_a_file_no_folder_is_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"Not a directory|File exists"):
        durable.write_output(tmp_path / "file" / "report.html", b"page")


def test_a_lock_is_a_regular_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "victim")
    for name in ("pipe", "link"):
        with pytest.raises(OSError):
            durable.open_lock(tmp_path / name)
    assert not (tmp_path / "victim").exists()
    os.close(durable.open_lock(tmp_path / "lock"))
    assert (tmp_path / "lock").is_file()
