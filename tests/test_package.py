"""What is installed: one name, whatever else is on the path."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    # Files that git does not know, such as caches, stay behind.
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    source = folder / "source"
    for name in filter(None, listed.decode().split("\0")):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_symlink():
            (source / name).symlink_to((ROOT / name).readlink())
        elif (ROOT / name).exists():
            (source / name).write_bytes((ROOT / name).read_bytes())
    build = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--wheel-dir",
        folder,
    ]
    subprocess.run([*build, source], check=True)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture
def beside_others(wheel: Path, tmp_path: Path) -> dict[str, str]:
    """The environment of a shell with foreign folders first on the path, then what the wheel installs."""
    for name in ("common", "launch", "studies", "scenarios"):
        (tmp_path / "foreign" / name).mkdir(parents=True)
        (tmp_path / "foreign" / name / "__init__.py").write_text("raise ImportError('not ours')\n")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    path = os.pathsep.join(str(tmp_path / folder) for folder in ("foreign", "installed"))
    return {**os.environ, "PYTHONPATH": path}


def test_a_wheel_installs_one_name(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"waldnet"}
    assert {"waldnet/py.typed", "waldnet/scenarios/four-radars.toml", "waldnet/scenarios/solent/truth.jsonl"} < {*names}


def test_the_name_is_imported_beside_others(beside_others: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    command = [sys.executable, "-c", "import waldnet.launch.cli; print(waldnet.__file__)"]
    done = subprocess.run(
        command, cwd=tmp_path / "empty", env=beside_others, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(tmp_path / "installed" / "waldnet" / "__init__.py")


@pytest.mark.processes
def test_a_network_runs_beside_others(beside_others: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    start = [sys.executable, "-c", "from waldnet.launch.cli import main; main()"]
    command = [*start, "run", "four-radars", "--speed", "max", "--wait", "120", "--out", "report"]
    subprocess.run(command, cwd=tmp_path / "empty", env=beside_others, check=True)
    assert (tmp_path / "empty" / "report" / "decisions.json").exists()
