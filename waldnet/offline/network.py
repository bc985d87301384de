"""The in-memory network: the same shells as the processes, on threads and a bus within one process."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait

from waldnet.common.codec import decode
from waldnet.common.config import Scenario
from waldnet.common.inbox import Heard, Inbox
from waldnet.common.memory import MemoryNetwork
from waldnet.common.messages import Keys, Scan
from waldnet.common.transport import Bus
from waldnet.fusion_center.center import Center
from waldnet.fusion_center.shell import CenterShell
from waldnet.recording.record import Record
from waldnet.sensor_node.shell import NodeShell
from waldnet.sensor_node.sources import schedule_of
from waldnet.sensor_node.tracker import LocalTracker


def run_in_memory(scenario: Scenario, scans: Sequence[Scan], *, speed: float = 0.0) -> Record:
    """Run a whole network on threads of this process, codec and bus included.

    Args:
        scenario: the network.
        scans: all scans, by time.
        speed: seconds of measurement time per second; 0: lockstep.

    Returns:
        everything that was published.
    """
    memory, heard = MemoryNetwork(), Inbox()
    keys = Keys(scenario.network.name)
    schedule = schedule_of(scans, scenario)
    with memory.bus() as listener:
        for key in (keys.tracks(), keys.decision(), keys.plots()):
            listener.subscribe(key, heard.heard)
        center_bus = memory.bus()
        buses = {name: memory.bus() for name in scenario.sensor_names}
        center = CenterShell(center_bus, scenario.network, scenario, Center.of(scenario, speed=speed))
        nodes = [
            NodeShell(
                bus,
                scenario.network,
                LocalTracker.of(scenario, name, schedule),
                [scan for scan in scans if scan.sensor == name],
            )
            for name, bus in buses.items()
        ]
        shells: list[CenterShell | NodeShell] = [center, *nodes]
        with ThreadPoolExecutor(len(shells)) as pool:
            running = [
                pool.submit(_run, shell, bus) for shell, bus in zip(shells, [center_bus, *buses.values()], strict=True)
            ]
            done, _ = wait(running, return_when=FIRST_EXCEPTION)
            for shell in shells:
                shell.stop()
            for future in done:
                future.result()
    record = Record(scenario)
    while not heard.empty:
        match heard.receive(None):
            case Heard(key, payload):
                record.note(decode(key, payload))
            case _:
                pass
    return record


def _run(shell: CenterShell | NodeShell, bus: Bus) -> None:
    with bus:
        shell.run()
