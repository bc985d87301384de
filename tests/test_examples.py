"""The scripts in ``examples/`` run as they stand there, and say what they are meant to show."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "examples"
#: What each says, among other things.
SAID = {
    "replay": ["track 0 confirmed after 3 scans, log LR +10.5", "the same from lists: True"],
    "own_filter": ["log LR  +0.0 confirmed", "deleted"],
    "formation": ["8 s: how many? 1: 0.00, 2: 0.00, 3: 1.00, 4: 0.00", "smoothed: RMSE"],
    "modes": ["selected plots", "5 of 5"],
    "evaluate_recording": ["confirmed_targets          2.00         2.00"],
}


def test_every_example_is_asked() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} == SAID.keys()


@pytest.mark.parametrize("name", SAID)
def test_an_example_runs(name: str, tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", FOLDER / f"{name}.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for text in SAID[name]:
        assert text in done.stdout
