"""Processes of a benchmark: each tells its results as JSON lines, none is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import IO, Any, Self

from waldnet.common.errors import WaldnetError

_GRACE_S = 5.0


class BenchError(WaldnetError):
    """A benchmark cannot be run; says why."""


class Member:
    """One process: what it says is read line by line, what it is told goes to its standard input."""

    def __init__(self, argv: Sequence[str], within: Sequence[str]) -> None:
        """Start ``python -m argv``, prefixed with ``within``."""
        self._name = " ".join(argv)
        self._log: IO[str] = tempfile.TemporaryFile("w+")  # noqa: SIM115 (lives as long as the process)
        self._process = subprocess.Popen(
            [*within, sys.executable, "-P", "-m", *argv],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            start_new_session=True,
        )

    def hear(self) -> Any:
        """The next thing it says.

        Raises:
            BenchError: it ended instead.
        """
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._log.seek(0)
            words = self._log.read().strip().splitlines() or ["it said nothing"]
            raise BenchError(f"{self._name}: ended with exit code {self._process.wait()}: {words[-1]}")
        return json.loads(line)

    def tell(self, words: str) -> None:
        """Say a line to it."""
        assert self._process.stdin is not None
        self._process.stdin.write(words + "\n")
        self._process.stdin.flush()

    def end(self) -> None:
        """Close its standard input, which ends it; kill it if it does not."""
        try:
            self._process.communicate(timeout=_GRACE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
        self._log.close()


class Crew:
    """All processes of a benchmark, and its own connections to them; a context manager that ends them."""

    def __init__(self) -> None:
        """Nobody yet."""
        self._members = ExitStack()

    def start(self, *argv: str, within: Sequence[str] = ()) -> Member:
        """Start ``python -m argv``, for example in a network namespace: ``within`` is put before the command."""
        member = Member(argv, within)
        self._members.callback(member.end)
        return member

    def will(self, close: Callable[[], object]) -> None:
        """Have something closed at the end, whatever the end: Zenoh must be, or the interpreter does not."""
        self._members.callback(close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._members.close()
