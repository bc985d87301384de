"""Several hosts on one machine: network namespaces, joined by a switch or by bad links.

with Namespaces("center", "radar-1", links={"radar-1": Link(rate_bit_s=64e3, delay_s=0.2)}) as net:
    subprocess.Popen(net.command("radar-1", ["waldnet", "node", ..., f"tcp/{net.address('center')}:7447"]))
    net.bytes("radar-1").sent
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self


class Link(NamedTuple):
    """What joins a host to all others; each direction has its own queue and chance.

    Attributes:
        rate_bit_s: of IP packets; 0 is as fast as can be.
        delay_s: one way.
        jitter_s: the delay varies by so much, uniformly, up and down; order is kept.
        loss: probability of a packet.
        queue_bytes: what would wait beyond this for the rate is dropped.
    """

    rate_bit_s: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    queue_bytes: float = 64_000.0


class Counters(NamedTuple):
    """What passed a host's interface: over links bytes of IP packets, over a switch with 14 more for Ethernet each."""

    sent: int
    received: int
    packets_sent: int
    packets_received: int


class Namespaces:
    """Hosts in network namespaces; a context manager that ends everything inside, and nothing outlives it."""

    def __init__(self, *hosts: str, links: Mapping[str, Link] | None = None, seed: int = 1) -> None:
        """Set up; nothing is built yet.

        Args:
            hosts: names.
            links: of hosts whose link is not perfect; None: a switch at the kernel's speed, and no emulation.
            seed: of losses and jitter.
        """
        self._hosts = hosts
        every = {host: (links or {}).get(host, Link())._asdict() for host in hosts}
        self._plan = ["bridge", 0, every] if links is None else ["links", seed, every]

    @staticmethod
    def lacking() -> str:
        """What this machine lacks to build them; empty if nothing."""
        needs = {
            "root": os.geteuid() == 0,
            "ip": shutil.which("ip") is not None,
            "nsenter": shutil.which("nsenter") is not None,
            "/dev/net/tun": Path("/dev/net/tun").exists(),
        }
        return ", ".join(need for need, met in needs.items() if not met)

    def __enter__(self) -> Self:
        emulator = Path(__file__).with_name("link_emulator.py")
        self._keeper = subprocess.Popen(
            [sys.executable, str(emulator)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C must not take the network from under the processes that end in order.
        )
        self._namespaces: dict[str, int] = dict(zip(self._hosts, self._tell(*self._plan), strict=True))
        return self

    def __exit__(self, *_: object) -> None:
        self._keeper.communicate()

    def command(self, host: str, words: Sequence[str]) -> list[str]:
        """The command line that runs a command on a host; signals reach the command itself."""
        return ["nsenter", f"--net=/proc/{self._keeper.pid}/fd/{self._namespaces[host]}", "--", *words]

    def address(self, host: str) -> str:
        """IP address of a host."""
        return f"10.77.0.{self._hosts.index(host) + 1}"

    def bytes(self, host: str) -> Counters:
        """What passed the host's interface so far."""
        table = subprocess.check_output(self.command(host, ["cat", "/proc/net/dev"]), text=True)
        (line,) = [line for line in table.splitlines() if line.strip().startswith("wire0:")]
        numbers = [int(word) for word in line.split(":")[1].split()]
        return Counters(sent=numbers[8], received=numbers[0], packets_sent=numbers[9], packets_received=numbers[1])

    def change(self, host: str, link: Link) -> None:
        """Give a host another link from now on."""
        self._tell("set", host, link._asdict())

    def cut(self, host: str) -> None:
        """Lose everything in both directions from now on."""
        self._tell("cut", host)

    def heal(self, host: str) -> None:
        """End a cut."""
        self._tell("heal", host)

    def traffic(self, host: str) -> dict[str, dict[str, int]]:
        """Packets, bytes, lost and overflowed packets of a host's link, of those "sent" and "heard"."""
        told: dict[str, dict[str, int]] = self._tell("stats", host)
        return told

    def _tell(self, *words: object) -> Any:
        assert self._keeper.stdin is not None
        assert self._keeper.stdout is not None
        self._keeper.stdin.write(json.dumps(words) + "\n")
        self._keeper.stdin.flush()
        answer = self._keeper.stdout.readline()
        if not answer:
            raise RuntimeError("the link emulator has ended")
        return json.loads(answer)
