"""Files that appear whole: what a reader sees while one is written, and what is left where the writing fails."""

from pathlib import Path

import pytest

from dsvla_jax.errors import UserError
from dsvla_jax.files import replacing, whole_folder, write_bytes


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_has_its_old_content_until_the_new_one_is_whole(tmp_path: Path, durable: bool):
    file = tmp_path / "numbers.txt"
    file.write_text("old")
    with replacing(file, durable=durable) as partial:
        partial.write_text("half of the new")
        assert file.read_text() == "old"
        partial.write_text("new")
    assert file.read_text() == "new"
    assert list(tmp_path.iterdir()) == [file]


def test_where_writing_fails_the_old_file_stays_and_nothing_else(tmp_path: Path):
    file = tmp_path / "numbers.txt"
    file.write_text("old")
    with pytest.raises(UnicodeEncodeError), replacing(file) as partial:
        partial.write_text("half \udcff", encoding="utf-8")
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match=r"folder: not written: .*; free space or correct the permissions"):
        write_bytes(tmp_path / "folder", b"")
    assert {path.name for path in tmp_path.iterdir()} == {"numbers.txt", "folder"}


def test_two_writers_of_a_shared_file_do_not_meet(tmp_path: Path):
    file = tmp_path / "note.json"
    with replacing(file, shared=True) as one, replacing(file, shared=True) as other:
        one.write_text("first")
        other.write_text("second")
    assert file.read_text() == "first"
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_appears_when_everything_is_in_it(tmp_path: Path):
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "left by a killed process").touch()
    with pytest.raises(FileNotFoundError), whole_folder(tmp_path / "out") as partial:
        (partial / "missing" / "file").touch()
    assert not list(tmp_path.iterdir())
    with whole_folder(tmp_path / "out") as partial:
        (partial / "file").touch()
        assert not (tmp_path / "out").exists()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["file"]
