"""``waldnet run``: all processes of a network on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from rich.console import Console

from waldnet.common import notice
from waldnet.common.clock import now_ns
from waldnet.common.codec import decode
from waldnet.common.config import Network, Scenario
from waldnet.common.errors import DecodeError
from waldnet.common.estimation.sprt import Status
from waldnet.common.files import write_atomically
from waldnet.common.inbox import Exited, Heard, Inbox, Incoming, Missed, Present, Said, Stopped
from waldnet.common.messages import NEVER, Clock, Decision, Keys, Scan, Tracks, sensor_of
from waldnet.common.process import stopped_by_signals
from waldnet.common.transport import Bus, open_zenoh
from waldnet.launch.left_out import left_out
from waldnet.launch.processes import Children, LaunchError, describe_exit
from waldnet.launch.status import LiveStatus
from waldnet.recording.inputs import Source
from waldnet.recording.run_folder import Report, RunFolder, describe, refuse_used

CENTER = "center"
#: Once all children have ended: time for what is still on its way to the launcher.
_LAST_WORDS_NS = 1_000_000_000


@dataclass(frozen=True)
class Order:
    """What to run.

    Attributes:
        scenario: as loaded.
        path: its file.
        plots: recorded plots instead of the scenario's.
        seed: of the simulated world.
        speed: seconds of measurement time per second, 0: lockstep.
        out: folder of the report.
        scans: of all sources, by time.
        wait_s: for the other sensors, once one has joined.
        verbose: tell and log decisions on tracks that were never confirmed too.
    """

    scenario: Scenario
    path: Path
    plots: Path | None
    seed: int
    speed: float
    out: Path
    scans: Sequence[Scan]
    wait_s: float = 10.0
    verbose: bool = False


class Run:
    """One run: starts the processes, watches them and the network, and tells how it ended."""

    def __init__(self, order: Order, folder: RunFolder, console: Console, inbox: Inbox) -> None:
        """Set up; nothing is started yet.

        Args:
            order: what to run.
            folder: where it is written down.
            console: where it is shown.
            inbox: where somebody may have asked to stop already.
        """
        self._order, self._folder, self._inbox = order, folder, inbox
        self._status = LiveStatus(order.scenario, folder.end_ns, console, verbose=order.verbose)
        self._children = Children(order.out / "logs", self._inbox)
        self._keys = Keys(order.scenario.network.name)
        self._shared: list[str] = []
        self._running: set[str] = set()
        self._finished = self._stopped = False

    def run(self) -> None:
        """Run to the end of all sources, or until stopped.

        Raises:
            LaunchError: the center did not start or died, or all sensors died.
        """
        listen = Network(name=self._keys.network, listen=("tcp/127.0.0.1:0",))
        with open_zenoh(listen) as bus:
            try:
                self._watch(bus)
                with self._status:
                    self._greet()
                    self._start_center(bus.endpoints())
                    self._follow()
                    self._follow_up(bus)
            finally:
                self._children.end()

    def _greet(self) -> None:
        scenario = self._order.scenario
        self._status.say(
            f"{scenario.name}: the fusion center and {len(scenario.sensors)} sensors run as processes of their own, "
            f"{len(scenario.hypotheses)} hypotheses to decide on"
        )

    def _watch(self, bus: Bus) -> None:
        for key in (self._keys.tracks(), self._keys.decision(), self._keys.clock(), self._keys.notice()):
            bus.subscribe(key, self._inbox.heard, history=200)
        bus.subscribe(self._keys.plots(), self._inbox.heard, reliable=False, on_miss=self._inbox.missed)
        bus.watch(self._keys.sensor_alive(), self._inbox.present)

    def _start_center(self, here: tuple[str, ...]) -> None:
        # Children take the network's name and nothing else of it from the scenario: all are on this machine.
        file = self._order.out / "network.toml"
        write_atomically(file, f'name = "{self._keys.network}"\n'.encode())
        self._shared = ["--network", str(file), *_options("--connect", here)]
        speed = str(self._order.speed) if self._order.speed else "max"
        how = ["--listen", "tcp/127.0.0.1:0", "--speed", speed, "--wait", str(self._order.wait_s)]
        how += ["--verbose"] if self._order.verbose else []
        self._start(CENTER, "waldnet.fusion_center", [str(self._order.path), *self._shared, *how])

    def _start_sensors(self, center: tuple[str, ...]) -> None:
        order = self._order
        source = ["--seed", str(order.seed), *(["--plots", str(order.plots)] if order.plots else [])]
        for name in order.scenario.sensor_names:
            arguments = [str(order.path), name, *self._shared, *_options("--connect", center), *source]
            self._start(name, "waldnet.sensor_node", arguments)

    def _start(self, name: str, module: str, arguments: list[str]) -> None:
        self._children.start(name, module, arguments)
        self._running.add(name)

    def _follow(self) -> None:
        """Until all children have ended by themselves, or must be ended."""
        until_ns: int | None = None
        while not self._stopped:
            if until_ns is None and not self._running:
                until_ns = now_ns() + _LAST_WORDS_NS
            if until_ns is not None and (self._finished or now_ns() >= until_ns):
                return
            self._work_off(self._inbox.receive(until_ns))

    def _follow_up(self, bus: Bus) -> None:
        """What had arrived by the end: keys are read side by side, the end may overtake the last picture."""
        bus.close()
        while not self._inbox.empty:
            self._work_off(self._inbox.receive(None))

    def _work_off(self, incoming: Incoming) -> None:
        match incoming:
            case Heard(key, payload):
                self._hear(key, payload)
            case Present(key, alive):
                self._status.present(sensor_of(key), alive)
            case Missed(key, number):
                self._plots_shed(sensor_of(key), number)
            case Said(name, listening) if name == CENTER:
                self._start_sensors(listening)
            case Exited(name, code):
                self._running.discard(name)
                self._child_ended(name, code)
            case Stopped():
                self._stopped = True
                self._status.say("stopped", "yellow")
            case _:
                pass

    def _hear(self, key: str, payload: bytes) -> None:
        try:
            if key == self._keys.notice():
                self._status.say(notice.decode(key, payload).text, "yellow")
                return
            message = decode(key, payload)
        except DecodeError as error:
            self._folder.refuse("bytes that are no message")
            self._leave_out("bytes that are no message", str(error))
            return
        if (reason := self._folder.note(message)) is not None:
            self._leave_out(reason, key)
            return
        match message:
            case Tracks():
                self._status.picture(message)
            case Decision():
                self._status.decided(message)
            case Clock():
                self._finished = message.clear_ns == NEVER
            case _:
                pass

    def _leave_out(self, reason: str, where: str) -> None:
        """Say why a message is left out, once for every reason."""
        if self._folder.refused[reason] == 1:
            self._status.say(f"left out: {reason} ({where})", "yellow")

    def _plots_shed(self, sensor: str, number: int) -> None:
        shed = self._folder.plots_shed
        if sensor not in shed:
            self._status.say(f"{sensor}: not all plots are shown, its link is full: reports go first", "yellow")
        shed[sensor] = shed.get(sensor, 0) + number

    def _child_ended(self, name: str, code: int) -> None:
        how = describe_exit(code)
        if name == CENTER:
            if code != 0 or not (self._finished or self._stopped):
                raise LaunchError(f"the fusion center died ({how}): {self._children.last_words(CENTER)}")
        elif code != 0:
            why = f"{how}: {self._children.last_words(name)}" if code > 0 else how
            self._folder.lost[name] = why
            self._status.lose(name)
            self._status.say(f"sensor {name} died ({why}); the run goes on with the others", "bold red")
            if set(self._folder.lost) == set(self._order.scenario.sensor_names):
                raise LaunchError("all sensors died; the logs in the report folder say why")


def _options(option: str, values: tuple[str, ...]) -> list[str]:
    return [word for value in values for word in (option, value)]


def default_folder(name: str, stamp: str) -> Path:
    """A folder for a run of a scenario that no other run has."""
    names = (f"{name}-{stamp}{f'-{number}' if number > 1 else ''}" for number in count(1))
    return next(folder for folder in (Path("runs") / one for one in names) if not folder.exists())


def execute(order: Order, console: Console) -> None:
    """Run and write the report, whatever the end.

    From here on SIGTERM and Ctrl-C end the run, and never the report.

    Raises:
        ConfigError: the folder holds a run already.
        LaunchError: the run failed, or a file could not be written; what was heard until then is in the report.
    """
    refuse_used(order.out)
    inbox = Inbox()
    with stopped_by_signals(inbox.stop):
        order.out.mkdir(parents=True, exist_ok=True)
        folder = RunFolder(order.out, order.scenario, Source(order.path.read_bytes(), order.scans))
        failures: list[str] = []
        try:
            Run(order, folder, console, inbox).run()
        except BrokenPipeError:
            raise
        except OSError as error:
            failures.append(describe(error))
        finally:
            report = folder.finish({"seed": order.seed, "speed": order.speed or "max"})
            for line in left_out(order.out / "logs"):
                console.print(line, soft_wrap=True)
            _tell(folder, report, console)
        if failures := [*failures, *report.failures]:
            raise LaunchError(f"{failures[0]}; the report is smaller for it, what it holds can be read")


def _tell(folder: RunFolder, report: Report, console: Console) -> None:
    """Say how a run ended and what is left of it."""
    if folder.plots_shed:
        shed = ", ".join(f"{number} of {sensor}" for sensor, number in sorted(folder.plots_shed.items()))
        console.print(f"scans not shown because a link was full: {shed}", soft_wrap=True)
    for reason, number in sorted(folder.refused.items()):
        console.print(f"messages left out: {number} ({reason})", soft_wrap=True)
    outcome = ", ".join(f"{folder.sketch.outcome[status]} {status.name.lower()}" for status in Status)
    console.print(f"tracks: {outcome}\nreport: {', '.join(map(str, report.files))}", soft_wrap=True)
