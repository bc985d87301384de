"""``waldnet run``: all processes of a network on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from common import notice
from common.clock import now_ns
from common.codec import decode
from common.config import Network, Scenario
from common.errors import DecodeError
from common.estimation.sprt import Status
from common.inbox import Exited, Heard, Inbox, Incoming, Missed, Present, Said, Stopped
from common.messages import NEVER, Clock, Decision, Keys, Scan, Tracks, sensor_of
from common.process import stopped_by_signals
from common.transport import Bus, open_zenoh
from launch.processes import Children, LaunchError, describe_exit
from launch.status import LiveStatus
from studies.inputs import Input, keep, looked_at
from studies.record import Record, write_report

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
    """

    scenario: Scenario
    path: Path
    plots: Path | None
    seed: int
    speed: float
    out: Path
    scans: Sequence[Scan]

    @property
    def end_ns(self) -> int:
        """Time of the last scan."""
        return self.scans[-1].time_ns if self.scans else self.scenario.epoch_ns


class Run:
    """One run: starts the processes, watches them and the network, and tells how it ended."""

    def __init__(self, order: Order, console: Console) -> None:
        """Set up; nothing is started yet."""
        self._order = order
        self._inbox = Inbox()
        self.record = Record(order.scenario)
        self._status = LiveStatus(self.record, order.end_ns, console)
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
        with stopped_by_signals(self._inbox.stop), open_zenoh(listen) as bus:
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
        file.write_text(f'name = "{self._keys.network}"\n')
        self._shared = ["--network", str(file), *_options("--connect", here)]
        speed = str(self._order.speed) if self._order.speed else "max"
        listen = ["--listen", "tcp/127.0.0.1:0"]
        self._start(CENTER, "fusion_center", [str(self._order.path), *self._shared, *listen, "--speed", speed])

    def _start_sensors(self, center: tuple[str, ...]) -> None:
        order = self._order
        source = ["--seed", str(order.seed), *(["--plots", str(order.plots)] if order.plots else [])]
        for name in order.scenario.sensor_names:
            arguments = [str(order.path), name, *self._shared, *_options("--connect", center), *source]
            self._start(name, "sensor_node", arguments)

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
            self._status.say(str(error), "yellow")
            return
        self.record.note(message)
        match message:
            case Tracks():
                self._status.picture(message)
            case Decision():
                self._status.decided(message)
            case Clock():
                self._finished = message.clear_ns == NEVER
            case _:
                pass

    def _plots_shed(self, sensor: str, number: int) -> None:
        shed = self.record.plots_shed
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
            self.record.lost[name] = why
            self._status.say(f"sensor {name} died ({why}); the run goes on with the others", "bold red")
            if set(self.record.lost) == set(self._order.scenario.sensor_names):
                raise LaunchError("all sensors died; the logs in the report folder say why")


def _options(option: str, values: tuple[str, ...]) -> list[str]:
    return [word for value in values for word in (option, value)]


def execute(order: Order, console: Console) -> None:
    """Run and write the report, whatever the end.

    Raises:
        LaunchError: the run failed; what was heard until then is in the report.
    """
    order.out.mkdir(parents=True, exist_ok=True)
    text = order.path.read_bytes()
    run = Run(order, console)
    try:
        run.run()
    finally:
        files = [*write_report(run.record, order.out, {"seed": order.seed, "speed": order.speed or "max"})]
        files.append(keep(order.out, text, Input(order.scenario, looked_at(run.record, order.scans))))
        last = [Status(int(history.status[-1])) for history in run.record.histories().values()]
        outcome = ", ".join(f"{last.count(status)} {status.name.lower()}" for status in Status)
        if run.record.plots_shed:
            shed = ", ".join(f"{number} of {sensor}" for sensor, number in sorted(run.record.plots_shed.items()))
            console.print(f"scans not shown because a link was full: {shed}", soft_wrap=True)
        console.print(f"tracks: {outcome}\nreport: {', '.join(str(file) for file in files)}", soft_wrap=True)
