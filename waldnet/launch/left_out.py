"""What center and nodes left out of a run, as their logs say at their end."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_UNUSABLE = ("unusable plots", "unusable tracks")


def left_out(logs: Path) -> Iterator[str]:
    """Lines about refused reports, and plots and tracks left out of reports.

    Args:
        logs: folder with a log file of every process; files without a last line of their own say nothing.
    """
    for file in sorted(logs.glob("*.log")):
        ended = _ended(file)
        for sensor, reasons in sorted(ended.get("refused", {}).items()):
            yield from (f"{file.stem}: refused {number} of {sensor}: {why}" for why, number in sorted(reasons.items()))
        for what in _UNUSABLE:
            if number := ended.get("dropped", {}).get(what):
                yield f"{file.stem}: left out {number} {what}"


def _ended(file: Path) -> dict[str, Any]:
    """The last line of a process that came to its end, or nothing."""
    for line in reversed(file.read_text(errors="replace").splitlines()):
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(entry, dict) and entry.get("event") == "ended":
            return entry
    return {}
