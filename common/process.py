"""What every process of a network does the same way: options, signals, errors, exit codes."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from cyclopts import App, Parameter, Token, validators

from waldnet.common.config import Network, Scenario, load_network
from waldnet.common.errors import WaldnetError


def speed_factor(_: object, tokens: Sequence[Token]) -> float:
    """A speed as given by users: a positive factor, or max; 0 stands for max: lockstep.

    Raises:
        ValueError: for anything else.
    """
    text = tokens[0].value
    if text == "max":
        return 0.0
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise ValueError(f"{text!r} is neither a positive factor nor max")
    return value


def _seconds(_: object, value: float | None) -> None:
    if value is not None and not 0.0 <= value < float("inf"):
        raise ValueError(f"{value} is no number of seconds")


#: Seconds, none or more.
Seconds: TypeAlias = Annotated[float, Parameter(validator=_seconds)]

#: Of a simulated world.
Seed: TypeAlias = Annotated[int, Parameter(validator=validators.Number(gte=0))]

#: Socket at which a process answers how it is; ask with python -m waldnet.common.health.
HealthSocket: TypeAlias = Annotated[Path | None, Parameter(name="--health")]

#: Whether decisions on tracks that were never confirmed are told too.
Verbose: TypeAlias = Annotated[bool, Parameter(negative=())]

#: A switch for launchers, not for people.
Hidden: TypeAlias = Annotated[bool, Parameter(show=False)]

#: Seconds of measurement time per second, on the command line.
Speed: TypeAlias = Annotated[float, Parameter(converter=speed_factor)]


@Parameter(name="*")
@dataclass(frozen=True)
class NetworkOptions:
    """How this process takes part in the network; what is not given is as in the scenario's [network].

    Attributes:
        network: file with the keys of [network] instead of the scenario's.
        connect: endpoint to connect to, such as tcp/192.168.1.7:7447; may be given several times.
        listen: endpoint to listen on; port 0 takes a free one.
        mode: peer, or client of a router.
        name: name of the network: the part of all keys after waldnet/.
    """

    network: Path | None = None
    connect: Annotated[tuple[str, ...], Parameter(negative=())] = ()
    listen: Annotated[tuple[str, ...], Parameter(negative=())] = ()
    mode: Literal["peer", "client"] | None = None
    name: Annotated[str | None, Parameter(name="--network-name")] = None

    def over(self, scenario: Scenario) -> Network:
        """The network of a scenario with these options over it.

        Raises:
            ConfigError: when the network file is wrong.
        """
        base = scenario.network if self.network is None else load_network(self.network)
        given = {"connect": self.connect, "listen": self.listen, "mode": self.mode, "name": self.name}
        return base.model_copy(update={key: value for key, value in given.items() if value})


@contextmanager
def stopped_by_signals(stop: Callable[[], None], *, with_parent: bool = False) -> Iterator[None]:
    """Call ``stop`` on SIGTERM, SIGINT and SIGHUP, and with ``with_parent`` when standard input closes.

    SIGHUP, which comes when a terminal is closed, is left alone where it is ignored, as nohup wants it.

    A launcher keeps the other end of its children's standard input open: however it dies, they end too.
    """

    def on_signal(*_: object) -> None:
        stop()

    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    numbers = (signal.SIGTERM, signal.SIGINT, *(() if ignored else (signal.SIGHUP,)))
    before = {number: signal.signal(number, on_signal) for number in numbers}
    if with_parent:
        threading.Thread(target=_until_closed, args=(stop,), daemon=True).start()
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _until_closed(stop: Callable[[], None]) -> None:
    # Not sys.stdin: a thread inside its buffer would trip the interpreter's shutdown.
    while os.read(0, 4096):
        pass
    stop()


_TOO_FAR_APART = (
    "double precision cannot hold a density of this network; standard deviations, speeds, accelerations and times "
    "between scans are too many orders apart"
)


def main(app: App, tokens: list[str] | None = None) -> Any:
    """Run a command line; our own errors end with one clear message and exit code 1.

    SIGINT ends it, even where whoever started it ignores SIGINT, as a shell does for what runs in the background.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # what a terminal cannot show is shown escaped
            stream.reconfigure(errors="backslashreplace")
    try:
        result = app(tokens)
        sys.stdout.flush()
        return result
    except WaldnetError as error:
        print(error, file=sys.stderr)  # noqa: T201 (what a user is told)
    except np.linalg.LinAlgError as error:
        print(f"{error}: {_TOO_FAR_APART}", file=sys.stderr)  # noqa: T201
    except BrokenPipeError:
        # Whoever read our output has seen enough; nothing is left to say, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(f"{error.filename or 'waldnet'}: {error.strerror}", file=sys.stderr)  # noqa: T201
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    sys.exit(1)
