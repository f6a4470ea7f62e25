"""The folder of an export: whole files, resumable, nothing outside it."""

import pytest

from cosim.addons.export.folder import Folder
from results.moments import File
from tests.drive import full_disk


def test_goes_on_where_it_stopped(tmp_path):
    folder = Folder.open(tmp_path / "out", {"format": "kitti", "vehicles": (1, 2)})
    folder.write(File("a/b.txt", lambda: b"one"))
    folder.finish("first")
    again = Folder.open(tmp_path / "out", {"format": "kitti", "vehicles": (1, 2)})
    assert again.done == ["first"] and (tmp_path / "out/a/b.txt").read_bytes() == b"one"
    with pytest.raises(ValueError, match=r"another export \(other vehicles\)"):
        Folder.open(tmp_path / "out", {"format": "kitti", "vehicles": (1, 3)})


def test_refuses_what_is_not_its_own(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="is not empty"):
        Folder.open(tmp_path, {})
    with pytest.raises(ValueError, match="cannot be used"):
        Folder.open(tmp_path / "thesis.tex", {})
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/export.progress").write_text("{")
    with pytest.raises(ValueError, match="cannot be used"):
        Folder.open(tmp_path / "broken", {})


def test_nothing_outside(tmp_path):
    folder = Folder.open(tmp_path / "out", {})
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out/link").symlink_to(tmp_path / "elsewhere")
    for path in ("../x.txt", "a/../../x.txt", "link/x.txt"):
        with pytest.raises(ValueError, match="lies outside"):
            folder.write(File(path, lambda: b""))
    assert not list((tmp_path / "elsewhere").iterdir()) and not (tmp_path / "x.txt").exists()


def test_a_full_disk_is_one_line(tmp_path):
    folder = Folder.open(tmp_path / "out", {})
    with pytest.raises(ValueError, match=r"cannot be written: No space left on device.*goes on there"):
        folder.write(File("a.bin", full_disk))
    with pytest.raises(ValueError, match="GB are to be written"):
        folder.check_room(1e18)
    assert not (tmp_path / "out/a.bin").exists()


def test_links(tmp_path):
    folder = Folder.open(tmp_path / "out", {})
    folder.write(File("a.bin", lambda: b"cloud"))
    folder.write(File("b/c.bin", lambda: b"", same_as="a.bin"))
    assert (tmp_path / "out/b/c.bin").samefile(tmp_path / "out/a.bin")
