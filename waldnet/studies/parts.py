"""Finished parts of a study, one file per variant, mode and block of runs, so that it can go on where it stopped."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from waldnet.common.errors import ConfigError
from waldnet.common.files import write_atomically
from waldnet.studies.metrics import Result
from waldnet.studies.plan import Job, part_digest

_MANIFEST = "study.json"
#: What a manifest tells apart, and how people call it.
_WORDS = {
    "scenario": "scenario",
    "seed": "seed",
    "block": "runs per block",
    "program": "version of waldnet or of NumPy",
}


class Store:
    """The folder of a study."""

    def __init__(self, folder: Path, manifest: Mapping[str, Any], *, fresh: bool = False) -> None:
        """Open the folder, or make it.

        Args:
            folder: of the study.
            manifest: what all its parts have in common.
            fresh: discard the parts that are there.

        Raises:
            ConfigError: when the folder is none, or holds parts of another study.
        """
        self.folder = folder
        if folder.exists() and not folder.is_dir():
            raise ConfigError(f"{folder}: is a file; --out takes a folder")
        if fresh:
            shutil.rmtree(folder / "parts", ignore_errors=True)
            (folder / _MANIFEST).unlink(missing_ok=True)
        self._compare(manifest)
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / _MANIFEST, (json.dumps(dict(manifest), indent=2) + "\n").encode())

    def _compare(self, manifest: Mapping[str, Any]) -> None:
        file = self.folder / _MANIFEST
        try:
            there = json.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return
        except ValueError:
            there = None
        if not isinstance(there, dict):
            raise ConfigError(f"{file}: is not what a study writes; take another --out, or --fresh to begin anew")
        faults = [
            f"another {_WORDS[key]} ({there.get(key)}, now {manifest[key]})"
            for key in _WORDS
            if there.get(key) != manifest[key]
        ]
        if faults:
            raise ConfigError(
                f"{self.folder}: holds parts of another study: {'; '.join(faults)}. "
                "Take another --out, or --fresh to discard them"
            )

    def load(self, job: Job, mode: str) -> Result | None:
        """A finished part; None when it is missing, damaged, or of something else."""
        try:
            with np.load(io.BytesIO(self._path(job, mode).read_bytes()), allow_pickle=False) as part:
                if str(part["digest"]) != part_digest(job, mode):
                    return None
                local = part.get("local_log_lr")
                uplink, downlink = part["bytes"].tolist()
                return Result(part["times_ns"], part["log_lr"], part["error_m"], part["nees"], uplink, downlink, local)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return None

    def has(self, job: Job, mode: str) -> bool:
        """Whether a part is finished."""
        return self.load(job, mode) is not None

    def save(self, job: Job, mode: str, result: Result) -> None:
        """Keep a part; it is there whole or not at all."""
        arrays = {
            "digest": np.array(part_digest(job, mode)),
            "seeds": job.seeds,
            "times_ns": result.times_ns,
            "log_lr": result.log_lr,
            "error_m": result.error_m,
            "nees": result.nees,
            "bytes": np.array([result.uplink_bytes, result.downlink_bytes]),
        }
        if result.local_log_lr is not None:
            arrays["local_log_lr"] = result.local_log_lr
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        path = self._path(job, mode)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, buffer.getvalue())

    def _path(self, job: Job, mode: str) -> Path:
        name = f"{job.first:07d}-{job.first + len(job.seeds) - 1:07d}.npz"
        return self.folder / "parts" / job.variant.name / mode / name
