"""Child processes: each with its log file, none left behind."""

from __future__ import annotations

import json
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from common.errors import WaldnetError

#: How long a child may take to end after SIGTERM before it is killed.
_GRACE_S = 5.0
#: How long the center may take to listen.
_READY_S = 30.0


class LaunchError(WaldnetError):
    """A process of the network did not do what it should; says which and why."""


class Children:
    """The processes of a network.

    Every child holds the read end of a pipe as its standard input and ends when that closes: should this process be
    killed, nothing stays behind.
    """

    def __init__(self, logs: Path, exited: Callable[[str, int], None]) -> None:
        """Keep track of children.

        Args:
            logs: folder of the log files.
            exited: called on a thread of its own with name and exit code whenever a child ends.
        """
        self._logs, self._exited = logs, exited
        self._children: dict[str, subprocess.Popen[str]] = {}
        logs.mkdir(parents=True, exist_ok=True)

    def start(self, name: str, module: str, arguments: Sequence[str]) -> None:
        """Start ``python -m module``; its messages go to NAME.log."""
        with self._log(name).open("w") as log:
            child = subprocess.Popen(
                [sys.executable, "-m", module, *arguments, "--log", "json", "--with-parent"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                start_new_session=True,  # Ctrl-C is for the launcher, which ends the children in order.
            )
        self._children[name] = child
        threading.Thread(target=self._wait, args=(name, child), daemon=True).start()

    def first_line(self, name: str) -> dict[str, list[str]]:
        """What a child says of itself once it is ready.

        Raises:
            LaunchError: it ended instead, or said nothing in time.
        """
        output = self._children[name].stdout
        assert output is not None
        ready, _, _ = select.select([output], [], [], _READY_S)
        line = output.readline() if ready else ""
        if not line:
            raise LaunchError(f"{name} did not start: {self.last_words(name)}")
        said: dict[str, list[str]] = json.loads(line)
        return said

    def last_words(self, name: str) -> str:
        """The end of a child's log."""
        lines = self._log(name).read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def pid(self, name: str) -> int:
        """Process id of a child."""
        return self._children[name].pid

    def running(self) -> list[str]:
        """Names of the children that have not ended."""
        return [name for name, child in self._children.items() if child.poll() is None]

    def end(self) -> None:
        """End all children: SIGTERM, and after a grace SIGKILL."""
        for name in self.running():
            self._children[name].send_signal(signal.SIGTERM)
        self.join(_GRACE_S)
        for name in self.running():
            self._children[name].kill()
        self.join(_GRACE_S)
        for child in self._children.values():
            for pipe in (child.stdin, child.stdout):
                if pipe is not None:
                    pipe.close()

    def join(self, seconds: float) -> None:
        """Wait until all children have ended, or for ``seconds``."""
        until = time.monotonic() + seconds
        for child in self._children.values():
            try:
                child.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                return

    def _wait(self, name: str, child: subprocess.Popen[str]) -> None:
        self._exited(name, child.wait())

    def _log(self, name: str) -> Path:
        return self._logs / f"{name}.log"


def describe_exit(code: int) -> str:
    """An exit code in words."""
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
