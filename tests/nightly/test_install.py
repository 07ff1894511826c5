"""The environment: which Pythons the pins resolve for, and what comes from a folder of wheels without a network."""

from __future__ import annotations

import ensurepip
import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest
from running import ROOT

UV = shutil.which("uv") or shutil.which("uv", path=str(ROOT / ".cache/uv/bin"))
pytestmark = pytest.mark.skipif(not UV, reason="no uv here (make env gets it)")


@pytest.mark.parametrize(
    ("python", "resolves"), [("3.11.4", False), ("3.11.5", True), ("3.12", True), ("3.13", True), ("3.14", False)]
)
def test_pythons_for_which_all_pins_have_wheels(python: str, resolves: bool) -> None:
    """Hydra's antlr4 is published as source alone."""
    command = f"pip compile -q pyproject.toml --extra test --extra docs -c constraints.txt --python-version {python}"
    done = subprocess.run(
        [str(UV), *command.split(), "--only-binary=:all:", "--no-binary=antlr4-python3-runtime"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if "Failed to fetch" in done.stderr:
        pytest.skip("no package index can be reached")
    assert (done.returncode == 0) == resolves, done.stderr
    assert resolves or "No solution found" in done.stderr


def test_an_environment_from_a_folder_of_wheels(tmp_path: Path) -> None:
    """`make env` as docs/install.md has it without a network, for a package that no index has."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / ".cache/uv/bin").mkdir(parents=True)
    (tmp_path / ".cache/uv/bin/uv").symlink_to(str(UV))
    wheels = Path(shutil.copytree(Path(ensurepip.__file__).parent / "_bundled", tmp_path / "wheels"))
    for name in ("wheel", "tiny"):
        with ZipFile(wheels / f"{name}-1-py3-none-any.whl", "w") as file:
            file.writestr(f"{name}.py", "")
            file.writestr(f"{name}-1.dist-info/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
            file.writestr(f"{name}-1.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
            file.writestr(f"{name}-1.dist-info/RECORD", "")
    subprocess.run(
        [
            "make",
            "env",
            "PACKAGES=tiny",
            "UV_OFFLINE=1",
            "PIP_NO_INDEX=1",
            f"WHEELS={wheels}",
            f"PYTHON={sys.executable}",
        ],
        cwd=tmp_path,
        env=os.environ | {"UV_CACHE_DIR": str(tmp_path / "kept")},
        check=True,
    )
    subprocess.run([tmp_path / ".venv/bin/python", "-c", "import pip, tiny"], check=True)
