"""Why the center refuses what a sensor says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias

#: Reasons in words that logs, health and the end of a run show.
Refusal: TypeAlias = Literal[
    "unknown sensor",
    "another scenario",
    "not joined",
    "older epoch",
    "epoch not in force",
    "next scan not after this one",
    "time too far ahead",
    "another fusion mode",
    "wrong dimensions",
    "too many terms",
    "position out of range",
    "unclaimed plots of another sensor",
]

#: How often each sensor was refused for each reason.
Refused: TypeAlias = Mapping[tuple[str, str], int]

#: Whoever reaches the network may invent names: beyond so many entries they are counted together.
_MOST_ENTRIES = 500
_OTHERS = "others"


def add(refused: Refused, sensor: str, refusal: Refusal) -> Refused:
    """The counts with one more refusal."""
    key = (sensor, refusal)
    if key not in refused and len(refused) >= _MOST_ENTRIES:
        key = (_OTHERS, refusal)
    return {**refused, key: refused.get(key, 0) + 1}


def by_sensor(refused: Refused) -> dict[str, dict[str, int]]:
    """The same counts as nested tables for JSON: sensor, reason, number."""
    nested: dict[str, dict[str, int]] = {}
    for (sensor, refusal), number in sorted(refused.items()):
        nested.setdefault(sensor, {})[refusal] = number
    return nested
