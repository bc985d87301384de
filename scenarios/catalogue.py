"""The scenarios that come with the package."""

from __future__ import annotations

from pathlib import Path

from waldnet.common.errors import ConfigError

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def find(scenario: str) -> Path:
    """The file of a scenario given by path or by the name of one that comes with the package.

    Raises:
        ConfigError: when there is neither.
    """
    path = Path(scenario)
    if path.is_file():
        return path
    shipped = FOLDER / f"{scenario}.toml"
    if shipped.is_file():
        return shipped
    raise ConfigError(f"{scenario}: no such file, and none of the scenarios that come along: {', '.join(names())}")
