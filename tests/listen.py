"""Prints what a network says, as it arrives: wall time, key and payload in hexadecimal, one message a line.

python listen.py ENDPOINT NETWORK [plots]
"""

from __future__ import annotations

import sys
import threading
import time

from waldnet.common.config import Network
from waldnet.common.messages import Keys
from waldnet.common.transport import open_zenoh

_lock = threading.Lock()


def say(*words: object) -> None:
    """One line at a time, whoever speaks."""
    with _lock:
        print(time.time_ns(), *words, flush=True)


def heard(key: str, payload: bytes) -> None:
    say(key, payload.hex())


def missed(key: str, number: int) -> None:
    say(key, "missed", number)


def main() -> None:
    """Listen until the center has gone."""
    endpoint, name, *plots = sys.argv[1:]
    keys, gone = Keys(name), threading.Event()
    with open_zenoh(Network(connect=(endpoint,))) as bus:
        for key in (keys.tracks(), keys.report(), keys.clock()):
            bus.subscribe(key, heard, on_miss=missed)
        if plots:
            bus.subscribe(keys.plots(), heard, reliable=False, on_miss=missed)
        there = threading.Event()
        bus.watch(keys.center_alive(), lambda _, alive: (there if alive else gone).set())
        assert there.wait(60.0)
        assert bus.ask(keys.picture(), 60.0)
        say("listening")
        gone.wait()


main()
