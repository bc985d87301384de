"""Protocol traces: what is sent in small networks, message by message, and why (``tests/traces/*.txt``).

``pytest tests/test_traces.py --rewrite-traces`` writes them anew; read the difference before you commit it.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from trace_player import play

FILES = sorted((Path(__file__).parent / "traces").glob("*.txt"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_messages_of_a_trace_are_those_it_shows(path: Path, request: pytest.FixtureRequest) -> None:
    shown = path.read_text()
    played = play(shown)
    if request.config.getoption("--rewrite-traces"):
        path.write_text(played)
    else:
        assert played == shown


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_trace_begins_with_why(path: Path) -> None:
    why = path.read_text().partition("\n\n")[0].splitlines()
    assert len(why) > 1
    assert all(line.startswith("# ") for line in why)
