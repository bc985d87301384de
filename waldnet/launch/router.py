"""``waldnet router``: carries what the processes of any number of networks say."""

from __future__ import annotations

import json
from pathlib import Path

from waldnet.common.config import Network
from waldnet.common.health import answering
from waldnet.common.inbox import Asked, Inbox, Present, Stopped
from waldnet.common.messages import Keys
from waldnet.common.process import stopped_by_signals
from waldnet.common.transport import open_zenoh


def serve(network: Network, health: Path | None) -> None:
    """Route until stopped; the tokens of all networks tell who is there.

    Raises:
        TransportError: an endpoint is malformed or taken.
    """
    inbox, there = Inbox(), set[str]()
    every = Keys("*")
    with stopped_by_signals(inbox.stop), answering(health, inbox.asked), open_zenoh(network) as bus:
        for key in (every.sensor_alive(), every.center_alive()):
            bus.watch(key, inbox.present)
        print(json.dumps({"listening": bus.endpoints()}), flush=True)
        while not isinstance(incoming := inbox.receive(None), Stopped):
            match incoming:
                case Present(key, alive):
                    (there.add if alive else there.discard)(key)
                case Asked(answer):
                    answer({"role": "router", "linked": True, "there": sorted(there)})
                case _:
                    pass
