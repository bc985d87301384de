"""Child processes: each with its log file, none left behind."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from waldnet.common.errors import WaldnetError
from waldnet.common.inbox import Inbox

#: How long a child may take to end after SIGTERM before it is killed.
_GRACE_S = 5.0


class LaunchError(WaldnetError):
    """A process of the network did not do what it should; says which and why."""


class Children:
    """The processes of a network.

    Every child holds the read end of a pipe as its standard input and ends when that closes: should this process be
    killed, nothing stays behind.
    """

    def __init__(self, logs: Path, inbox: Inbox) -> None:
        """Keep track of children.

        Args:
            logs: folder of the log files.
            inbox: told where a child listens, once it does, and of every end.
        """
        self._logs, self._inbox = logs, inbox
        self._children: dict[str, subprocess.Popen[str]] = {}
        logs.mkdir(parents=True, exist_ok=True)

    def start(self, name: str, module: str, arguments: Sequence[str]) -> None:
        """Start ``python -m module``; its messages go to NAME.log."""
        with self._log(name).open("w") as log:
            child = subprocess.Popen(
                # -P: a folder of the user's that is named like one of ours must not take its place.
                [sys.executable, "-P", "-m", module, *arguments, "--log", "json", "--with-parent"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                start_new_session=True,  # Ctrl-C is for the launcher, which ends the children in order.
            )
        self._children[name] = child
        threading.Thread(target=self._attend, args=(name, child), daemon=True).start()

    def last_words(self, name: str) -> str:
        """The end of a child's log."""
        lines = self._log(name).read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

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
            if child.stdin is not None:
                child.stdin.close()

    def join(self, seconds: float) -> None:
        """Wait until all children have ended, or for ``seconds``."""
        until = time.monotonic() + seconds
        for child in self._children.values():
            try:
                child.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                return

    def _attend(self, name: str, child: subprocess.Popen[str]) -> None:
        """Read what a child says, to the end, and wait for it."""
        assert child.stdout is not None
        with child.stdout as output:
            for line in output:
                if line.startswith('{"listening"'):
                    self._inbox.said(name, tuple(json.loads(line)["listening"]))
        self._inbox.exited(name, child.wait())

    def _log(self, name: str) -> Path:
        return self._logs / f"{name}.log"


def describe_exit(code: int) -> str:
    """An exit code in words."""
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
