"""What a figure was measured on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path


def machine(*packages: str) -> dict[str, str | int | None]:
    """Processor, cores, Python, and the versions of packages."""
    versions = {name: version(name) for name in packages}
    return {"cpu": _cpu(), "cores": os.cpu_count(), "python": platform.python_version(), **versions}


def described(*packages: str) -> str:
    """The machine in one line."""
    return ", ".join(f"{key} {value}" for key, value in machine(*packages).items())


def _cpu() -> str:
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.exists() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
