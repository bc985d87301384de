"""The network of bad links that other tests run on: is it as bad as it says, and does it leave nothing behind?"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from waldnet.benchmarks.namespaces import Link, Namespaces

pytestmark = pytest.mark.netns

BAD = Link(rate_bit_s=64e3, delay_s=0.1, jitter_s=0.02, loss=0.2, queue_bytes=20_000)

#: Sends 200 numbered datagrams of 200 bytes to a host; the other side prints when which arrived, until one is empty.
SEND = """
import socket, sys
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for n in range(200):
    sock.sendto(b"%03d" % n + bytes(169), (sys.argv[1], 7000))
"""
HEAR = """
import socket, time
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.setsockopt(socket.SOL_SOCKET, 33, 1 << 20)  # SO_RCVBUFFORCE: a burst must not be lost here
sock.bind(("0.0.0.0", 7000))
sock.settimeout(3)
print("ready", flush=True)
try:
    while True:
        print(int(sock.recv(2000)[:3]), time.monotonic(), flush=True)
        sock.settimeout(1)
except TimeoutError:
    pass
"""


def start(net: Namespaces, host: str, program: str, *arguments: str) -> subprocess.Popen[str]:
    command = net.command(host, [sys.executable, "-c", program, *arguments])
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def send_all(net: Namespaces) -> list[tuple[int, float]]:
    """What arrived, and when."""
    with start(net, "b", HEAR) as hears:
        assert hears.stdout is not None
        assert hears.stdout.readline() == "ready\n"
        with start(net, "a", SEND, net.address("b")):
            arrived = [line.split() for line in hears.stdout]
    return [(int(number), float(when)) for number, when in arrived]


@pytest.fixture(params=["switch", "links"])
def perfect(request: pytest.FixtureRequest) -> Iterator[Namespaces]:
    with Namespaces("a", "b", links=None if request.param == "switch" else {}) as net:
        yield net


def test_hosts_reach_each_other_and_are_counted(perfect: Namespaces) -> None:
    before = perfect.bytes("a").sent, perfect.bytes("b").received
    assert [number for number, _ in send_all(perfect)] == list(range(200))
    for was, now in zip(before, (perfect.bytes("a").sent, perfect.bytes("b").received), strict=True):
        assert 200 * 200 <= now - was <= 200 * 214 + 300  # with Ethernet over the switch, and its address resolution


def test_a_bad_link_is_slow_lossy_and_full_but_keeps_order() -> None:
    with Namespaces("a", "b", links={"a": BAD}) as net:
        arrived = send_all(net)
        sent = net.traffic("a")["sent"]
    assert [number for number, _ in arrived] == sorted(number for number, _ in arrived)
    assert sent["overflowed"] == pytest.approx(200 - 20_000 / 200, abs=10)  # some leave while the burst comes
    assert sent["packets"] + sent["overflowed"] == 200
    assert len(arrived) == sent["packets"] - sent["lost"]
    assert 5 <= sent["lost"] <= 40
    took = arrived[-1][1] - arrived[0][1]
    numbers = arrived[-1][0] - arrived[0][0]
    assert took >= (numbers - sent["lost"] - sent["overflowed"]) * 200 * 8 / 64e3 - 2 * BAD.jitter_s


def test_the_same_seed_loses_the_same() -> None:
    unlimited = BAD._replace(rate_bit_s=0.0, jitter_s=0.0)
    got = []
    for seed in (1, 1, 2):
        with Namespaces("a", "b", links={"a": unlimited}, seed=seed) as net:
            got.append([number for number, _ in send_all(net)])
    assert got[0] == got[1] != got[2]


def test_a_cut_link_carries_nothing_until_it_is_healed() -> None:
    with Namespaces("a", "b", links={"b": Link()}) as net:
        net.cut("b")
        assert send_all(net) == []
        net.heal("b")
        assert len(send_all(net)) == 200


def test_nothing_stays_behind_when_the_owner_is_killed() -> None:
    owner = """
import os, subprocess, sys
from waldnet.benchmarks.namespaces import Namespaces
net = Namespaces("a").__enter__()
child = subprocess.Popen(net.command("a", ["sleep", "600"]))
with open(net.command("a", [])[1].removeprefix("--net=")) as handle:
    entering = subprocess.Popen(["sleep", "600"], pass_fds=[handle.fileno()])
print(net._keeper.pid, child.pid, entering.pid, flush=True)
os.kill(os.getpid(), 9)
"""
    root = Path(__file__).parents[1]
    ended = subprocess.run([sys.executable, "-c", owner], cwd=root, stdout=subprocess.PIPE, text=True, timeout=60)
    assert ended.returncode == -signal.SIGKILL
    for pid in map(int, ended.stdout.split()):
        await_end(pid)


def await_end(pid: int) -> None:
    """Return when a process has ended; the test's time limit is the patience."""
    with suppress(ProcessLookupError):
        handle = os.pidfd_open(pid)
        select.select([handle], [], [])
        os.close(handle)
