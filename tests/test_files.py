"""Files are written whole or not at all, and what is kept is for its user."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from running import contents

from pipeline import files
from pipeline.errors import StorageError
from pipeline.files import write_beside, write_folder, write_text


def test_what_a_killed_writer_left_goes_with_the_next_file(tmp_path: Path) -> None:
    """Its temporary file and folder, and nothing else that is hidden, or being written."""
    code = """import os, sys; from pathlib import Path; from pipeline.files import write_beside, write_folder
write_folder(Path(sys.argv[1], 'd'), lambda d: write_beside(d.parent / 'a.txt', lambda f: (f.touch(), os.abort())))"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False, cwd=Path(__file__).parents[1])
    left = sorted(tmp_path.iterdir())
    assert [path.name.partition("-")[0] for path in left] == [".a.writing", ".d.writing"]
    beside = left[0].with_name(re.sub(r"\d+\.txt", f"{os.getppid()}.txt", left[0].name))
    for path in (beside, tmp_path / ".mine"):
        path.touch()
    write_text(tmp_path / "b.txt", "new")
    assert sorted(tmp_path.iterdir()) == sorted([beside, tmp_path / ".mine", tmp_path / "b.txt"])


def test_what_is_kept_is_for_its_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "CACHE", tmp_path)
    files.keep("rotors", "key", b"content")
    assert files.look_up("rotors", "key") == b"content"
    assert (tmp_path / "rotors" / "key").stat().st_mode & 0o777 == 0o600


def test_a_folder_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    folder = tmp_path / "export"
    write_folder(folder, lambda beside: (beside / "old").write_text("1"))
    write_folder(folder, lambda beside: (beside / "new").write_text("2"))
    assert [path.name for path in folder.iterdir()] == ["new"]

    def fill(beside: Path) -> None:
        (beside / "newer").write_text("3")
        raise OSError(28, "No space left on device")

    with pytest.raises(StorageError, match=r"No space left on device.*output=FOLDER"):
        write_folder(folder, fill)
    assert [path.name for path in (*tmp_path.iterdir(), *folder.iterdir())] == ["export", "new"]
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StorageError, match="there is a file of that name"):
        write_folder(tmp_path / "file", fill)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt(), ValueError()])
def test_a_writer_that_fails_half_way(error: BaseException, tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_text("old")

    def write(beside: Path) -> None:
        beside.write_text("half")
        raise error

    with pytest.raises(StorageError if isinstance(error, OSError) else type(error)):
        write_beside(path, write)
    assert contents(tmp_path) == {"x.txt": b"old"}
