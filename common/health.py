"""Health of a process: it answers on a local socket, from its own loop, so that one that is stuck stays silent.

``python -m waldnet.common.health PATH [--max-age S]`` asks.
Standard library only: small machines ask every few seconds.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeAlias

from waldnet.common.errors import TransportError

Health: TypeAlias = dict[str, Any]
Answer: TypeAlias = Callable[[Health], None]

#: A loop that takes longer is stuck.
_PATIENCE_S = 2.0


def age_s(since_s: float | None) -> float | None:
    """Seconds since an instant of the monotonic clock, to milliseconds; None: it never was."""
    return None if since_s is None else round(time.monotonic() - since_s, 3)


@contextmanager
def answering(path: Path | None, ask: Callable[[Answer], None]) -> Iterator[None]:
    """Answer everyone who connects to a socket with one JSON object.

    Args:
        path: of the socket; one that a killed process left behind is replaced. None: nobody asks.
        ask: has the process's own loop call the answer; called on a thread of this module.

    Raises:
        TransportError: the path is taken, or cannot be one.
    """
    if path is None:
        yield
        return
    with closing(_listen(path)) as server:
        thread = threading.Thread(target=_serve, args=(server, ask), name="health", daemon=True)
        thread.start()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


def _listen(path: Path) -> socket.socket:
    server = socket.socket(socket.AF_UNIX)
    try:
        if path.is_socket() and not _answers(path):
            path.unlink()
        server.bind(str(path))
        server.listen()
    except OSError as error:
        server.close()
        raise TransportError(f"cannot answer for health at {path}: {error.strerror or error}") from None
    return server


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as client:
        return client.connect_ex(str(path)) == 0


def _serve(server: socket.socket, ask: Callable[[Answer], None]) -> None:
    while True:
        try:
            client, _ = server.accept()
        except OSError:  # closed
            return
        with client:
            answers: SimpleQueue[Health] = SimpleQueue()
            ask(answers.put)
            try:
                client.sendall(json.dumps(answers.get(timeout=_PATIENCE_S)).encode() + b"\n")
            except (Empty, OSError):  # stuck, or gone
                continue


def fault(health: Health, max_age_s: float | None) -> str | None:
    """What is wrong with a process, if anything."""
    age = health.get("last_report_s")
    if not health.get("linked"):
        return "not linked to its network"
    if max_age_s is not None and (age is None or age > max_age_s):
        return f"no report for {max_age_s:g} s"
    return None


def ask(path: str) -> Health:
    """Ask the process that listens at a path.

    Raises:
        OSError: nobody answers.
    """
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(2 * _PATIENCE_S)
        client.connect(path)
        line = client.makefile("rb").readline()
    if not line:
        raise TimeoutError("the process does not answer: it is stuck or about to end")
    answer: Health = json.loads(line)
    return answer


def main(words: list[str]) -> int:
    """Print how a process is; 0 if it is well."""
    match words:
        case [path] | [path, "--max-age", _]:
            pass
        case _:
            print("usage: python -m waldnet.common.health PATH [--max-age SECONDS]", file=sys.stderr)
            return 2
    try:
        max_age_s = float(words[2]) if len(words) > 1 else None
        health = ask(path)
    except (OSError, ValueError) as error:
        print(f"{path}: {error}")
        return 1
    why = fault(health, max_age_s)
    print(json.dumps(health if why is None else {"fault": why, **health}))
    return int(why is not None)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
