"""One suite for every way buses meet, then what only Zenoh can get wrong."""

from __future__ import annotations

import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from waldnet.common import transport
from waldnet.common.config import Network
from waldnet.common.errors import TransportError
from waldnet.common.memory import MemoryNetwork
from waldnet.common.transport import Bus, Publisher, open_zenoh

PATIENCE_S = 20
ANY_PORT = "tcp/127.0.0.1:0"

Join = Callable[[], Bus]


class Inbox:
    """What a callback was given."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()

    def __call__(self, key: str, content: Any) -> None:
        self._queue.put((key, content))

    def take(self, count: int) -> list[tuple[str, Any]]:
        return [self._queue.get(timeout=PATIENCE_S) for _ in range(count)]

    def rest(self) -> list[tuple[str, Any]]:
        return [self._queue.get_nowait() for _ in range(self._queue.qsize())]


def await_presence(bus: Bus, *keys: str) -> None:
    inbox = Inbox()
    for key in keys:
        bus.watch(key, inbox)
    assert sorted(inbox.take(len(keys))) == sorted((key, True) for key in keys)


def publish_early(sensor: Bus, center: Bus, key: str, count: int, **kind: Any) -> Publisher:
    """Publish, and return when nothing of it is under way any more: what was sent after it has arrived."""
    inbox = Inbox()
    center.subscribe("fence", inbox)
    center.announce("fence")
    await_presence(sensor, "fence")
    publisher = sensor.publisher(key, **kind)
    for n in range(count):
        publisher.put(b"%d" % n)
    sensor.publisher("fence").put(b"")
    inbox.take(1)
    return publisher


def free_endpoint() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


def memory(_: ExitStack) -> Join:
    return MemoryNetwork().bus


def star_of_peers(stack: ExitStack) -> Join:
    """The first to join listens, the others connect to it."""
    center: list[Bus] = []

    def join() -> Bus:
        network = Network(connect=center[0].endpoints()) if center else Network(listen=(ANY_PORT,))
        center.append(stack.enter_context(open_zenoh(network)))
        return center[-1]

    return join


def clients_of_a_router(stack: ExitStack) -> Join:
    router = stack.enter_context(open_zenoh(Network(mode="router", listen=(ANY_PORT,))))
    return lambda: stack.enter_context(open_zenoh(Network(mode="client", connect=router.endpoints())))


@pytest.fixture(params=[memory, star_of_peers, clients_of_a_router], ids=lambda meet: meet.__name__)
def join(request: pytest.FixtureRequest) -> Iterator[Join]:
    with ExitStack() as stack:
        yield request.param(stack)


@pytest.fixture(params=[star_of_peers, clients_of_a_router], ids=lambda meet: meet.__name__)
def join_zenoh(request: pytest.FixtureRequest) -> Iterator[Join]:
    with ExitStack() as stack:
        yield request.param(stack)


@pytest.mark.parametrize("reliable", [True, False])
def test_samples_arrive_in_order(join: Join, reliable: bool) -> None:
    center, sensor = join(), join()
    inbox = Inbox()
    center.subscribe("net/*/report", inbox, reliable=reliable)
    center.announce("net/center")
    await_presence(sensor, "net/center")
    publisher = sensor.publisher("net/radar/report", reliable=reliable)
    for n in range(100):
        publisher.put(b"%d" % n)
    assert inbox.take(100) == [("net/radar/report", b"%d" % n) for n in range(100)]


def test_many_sensors_reach_the_center_and_it_reaches_each(join: Join) -> None:
    center, reports = join(), Inbox()
    center.subscribe("net/sensor/*/report", reports)
    center.announce("net/center")
    advice = {name: Inbox() for name in "abc"}
    for name in advice:
        sensor = join()
        sensor.subscribe(f"net/sensor/{name}/advice", advice[name])
        sensor.announce(f"net/sensor/{name}")
        await_presence(sensor, "net/center")
        sensor.publisher(f"net/sensor/{name}/report").put(name.encode())
    await_presence(center, *(f"net/sensor/{name}" for name in advice))
    assert sorted(reports.take(3)) == [(f"net/sensor/{name}/report", name.encode()) for name in "abc"]
    for name, inbox in advice.items():
        center.publisher(f"net/sensor/{name}/advice").put(name.encode())
        assert inbox.take(1) == [(f"net/sensor/{name}/advice", name.encode())]


@pytest.mark.parametrize(
    ("key_expr", "heard"),
    [
        ("net/a", ["net/a"]),
        ("net/*", ["net/a", "net/b"]),
        ("net/*/c", ["net/a/c"]),
        ("net/**", ["net/a", "net/a/c", "net/a/c/d", "net/b"]),
        ("net/**/d", ["net/a/c/d"]),
        ("**", ["end", "net/a", "net/a/c", "net/a/c/d", "net/b"]),
    ],
)
def test_key_expressions_match_whole_chunks(join: Join, key_expr: str, heard: list[str]) -> None:
    center, sensor = join(), join()
    inbox = Inbox()
    center.subscribe(key_expr, inbox)
    if key_expr != "**":
        center.subscribe("end", inbox)
    center.announce("center")
    await_presence(sensor, "center")
    for key in ["net/a", "net/a/c", "net/a/c/d", "net/b", "other/a", "net/@a", "end"]:
        if not (key == "other/a" and key_expr == "**"):
            sensor.publisher(key).put(b"")
    expected = sorted({*heard, "end"})
    assert sorted(key for key, _ in inbox.take(len(expected))) == expected
    center.close()
    assert inbox.rest() == []


@pytest.mark.parametrize(("cache", "history", "expected"), [(50, 3, [7, 8, 9]), (2, 50, [8, 9]), (50, 50, range(10))])
def test_a_late_subscriber_gets_the_cached_samples(join: Join, cache: int, history: int, expected: list[int]) -> None:
    center, sensor = join(), join()
    publisher = publish_early(sensor, center, "net/report", 10, cache=cache)
    inbox = Inbox()
    center.subscribe("net/*", inbox, history=history)
    assert inbox.take(len(expected)) == [("net/report", b"%d" % n) for n in expected]
    publisher.put(b"live")
    assert inbox.take(1) == [("net/report", b"live")]


def test_without_history_a_late_subscriber_gets_only_what_follows(join: Join) -> None:
    center, sensor = join(), join()
    publisher = publish_early(sensor, center, "net/report", 1)
    inbox = Inbox()
    center.subscribe("net/*", inbox)
    center.announce("net/center")
    await_presence(sensor, "net/center")
    publisher.put(b"late")
    assert inbox.take(1) == [("net/report", b"late")]


def test_history_also_comes_from_a_publisher_that_joins_later(join: Join) -> None:
    center, inbox = join(), Inbox()
    center.subscribe("net/*", inbox, history=50)
    for n in range(3):
        publisher = join().publisher(f"net/{n}")
        publisher.put(b"first")
        assert inbox.take(1) == [(f"net/{n}", b"first")]


def test_a_display_publisher_keeps_no_history(join: Join) -> None:
    center, sensor = join(), join()
    publish_early(sensor, center, "net/display", 1, reliable=False)
    publish_early(sensor, center, "net/report", 1)
    inbox = Inbox()
    center.subscribe("net/*", inbox, history=50)
    assert inbox.take(1) == [("net/report", b"0")]


def test_a_bus_hears_itself(join: Join) -> None:
    bus, inbox = join(), Inbox()
    bus.subscribe("net/*", inbox)
    bus.watch("net/*", inbox)
    bus.publisher("net/a").put(b"1")
    assert inbox.take(1) == [("net/a", b"1")]
    bus.announce("net/me")
    assert inbox.take(1) == [("net/me", True)]
    bus.answer("net/question", lambda: b"2")
    assert bus.ask("net/*", PATIENCE_S) == [("net/question", b"2")]


@pytest.mark.parametrize("reliable", [True, False])
def test_a_publisher_knows_whether_anyone_listens(join: Join, reliable: bool) -> None:
    center, sensor = join(), join()
    publisher = sensor.publisher("net/a", reliable=reliable)
    deaf = sensor.publisher("net/b", reliable=reliable)
    assert not publisher.has_listeners
    center.subscribe("net/a", Inbox())
    center.announce("net/center")
    await_presence(sensor, "net/center")
    assert publisher.has_listeners
    assert not deaf.has_listeners
    sensor.close()
    assert not publisher.has_listeners


def test_watching_shows_who_is_there_and_then_every_change(join: Join) -> None:
    center, early, late = join(), join(), join()
    early.announce("net/sensor/early")
    early.announce("elsewhere/early")
    inbox = Inbox()
    center.watch("net/sensor/*", inbox)
    assert inbox.take(1) == [("net/sensor/early", True)]
    late.announce("net/sensor/late")
    assert inbox.take(1) == [("net/sensor/late", True)]
    early.close()
    assert inbox.take(1) == [("net/sensor/early", False)]
    late.close()
    assert inbox.take(1) == [("net/sensor/late", False)]
    again = join()
    again.announce("net/sensor/late")
    assert inbox.take(1) == [("net/sensor/late", True)]


def test_a_second_watch_does_not_repeat_tokens_to_the_first(join: Join) -> None:
    center, sensor = join(), join()
    sensor.announce("net/a")
    first, second = Inbox(), Inbox()
    center.watch("net/*", first)
    assert first.take(1) == [("net/a", True)]
    center.watch("net/**", second)
    assert second.take(1) == [("net/a", True)]
    sensor.announce("net/b")
    assert first.take(1) == [("net/b", True)]


def test_a_token_of_two_lives_until_the_second_is_gone(join: Join) -> None:
    center, one, two = join(), join(), join()
    inbox = Inbox()
    center.watch("net/*", inbox)
    one.announce("net/twin")
    two.announce("net/twin")
    two.announce("net/two")
    assert sorted(inbox.take(2)) == [("net/twin", True), ("net/two", True)]
    late = Inbox()
    center.watch("net/*", late)
    assert sorted(late.take(2)) == [("net/twin", True), ("net/two", True)]
    one.announce("net/one")
    one.close()
    assert inbox.take(2) == [("net/one", True), ("net/one", False)]
    two.close()
    assert sorted(inbox.take(2)) == [("net/twin", False), ("net/two", False)]


def test_who_sees_a_token_reaches_what_was_declared_before_it(join: Join) -> None:
    center = join()
    seen: queue.SimpleQueue[str] = queue.SimpleQueue()
    center.watch("net/sensor/*", lambda key, _: seen.put(key))
    for n in range(10):
        sensor, inbox = join(), Inbox()
        sensor.subscribe(f"net/advice/{n}", inbox)
        sensor.answer(f"net/state/{n}", lambda: b"ready")
        sensor.announce(f"net/sensor/{n}")
        assert seen.get(timeout=PATIENCE_S) == f"net/sensor/{n}"
        center.publisher(f"net/advice/{n}").put(b"now")
        assert inbox.take(1) == [(f"net/advice/{n}", b"now")]
        assert center.ask(f"net/state/{n}", PATIENCE_S) == [(f"net/state/{n}", b"ready")]


def test_asking_brings_every_answer(join: Join) -> None:
    center, sensors = join(), [join(), join()]
    for n, sensor in enumerate(sensors):
        sensor.answer(f"net/{n}/state", lambda n=n: b"%d" % n)
        sensor.answer("net/same", lambda n=n: b"%d" % n)
        sensor.announce(f"net/{n}")
    await_presence(center, "net/0", "net/1")
    assert sorted(center.ask("net/*/state", PATIENCE_S)) == [("net/0/state", b"0"), ("net/1/state", b"1")]
    assert center.ask("net/1/state", PATIENCE_S) == [("net/1/state", b"1")]
    assert sorted(center.ask("net/same", PATIENCE_S)) == [("net/same", b"0"), ("net/same", b"1")]
    assert center.ask("net/nobody", PATIENCE_S) == []


def use_publisher(bus: Bus, key: str) -> None:
    bus.publisher(key)


def use_subscribe(bus: Bus, key: str) -> None:
    bus.subscribe(key, Inbox())


def use_announce(bus: Bus, key: str) -> None:
    bus.announce(key)


def use_watch(bus: Bus, key: str) -> None:
    bus.watch(key, Inbox())


def use_answer(bus: Bus, key: str) -> None:
    bus.answer(key, bytes)


def use_ask(bus: Bus, key: str) -> None:
    bus.ask(key, PATIENCE_S)


USES = [use_publisher, use_subscribe, use_announce, use_watch, use_answer, use_ask]


@pytest.mark.parametrize("use", USES)
def test_a_bad_key_is_explained(join: Join, use: Callable[[Bus, str], None]) -> None:
    with pytest.raises(TransportError, match=r"^cannot .* net//a: .*`net//a`: empty chunks are forbidden[^/]*$"):
        use(join(), "net//a")


@pytest.mark.parametrize("use", USES)
def test_a_closed_bus_says_so(join: Join, use: Callable[[Bus, str], None]) -> None:
    with join() as bus:
        publisher = bus.publisher("net/a")
    bus.close()
    with pytest.raises(TransportError, match=r"^cannot .* net/a: session closed$"):
        use(bus, "net/a")
    with pytest.raises(TransportError, match=r"^cannot publish on net/a: session closed$"):
        publisher.put(b"")


def test_closing_delivers_what_has_arrived(join: Join) -> None:
    center, sensor = join(), join()
    inbox, arrived, go_on = Inbox(), threading.Event(), threading.Event()

    def deliver(key: str, payload: bytes) -> None:
        assert go_on.wait(PATIENCE_S)
        inbox(key, payload)

    center.subscribe("net/a", deliver)
    center.subscribe("net/end", lambda *_: arrived.set())
    center.announce("net/center")
    await_presence(sensor, "net/center")
    release = threading.Timer(0.1, go_on.set)
    release.start()
    publisher = sensor.publisher("net/a")
    for n in range(100):
        publisher.put(b"%d" % n)
    sensor.publisher("net/end").put(b"")
    assert arrived.wait(PATIENCE_S)
    center.close()
    assert [payload for _, payload in inbox.rest()] == [b"%d" % n for n in range(100)]
    release.join()


def lose_samples(join: Join, cache: int, inbox: Inbox, misses: Inbox) -> None:
    """Publish more than the links hold while the subscriber's thread stands still."""
    center, sensor = join(), join()
    stuck, go_on = threading.Event(), threading.Event()

    def deliver(key: str, payload: bytes) -> None:
        inbox(key, payload[:4])
        stuck.set()
        assert go_on.wait(PATIENCE_S)

    center.subscribe("net/*", deliver, on_miss=misses)
    center.announce("net/center")
    await_presence(sensor, "net/center")
    publisher = sensor.publisher("net/report", cache=cache)
    publisher.put(b"%04d" % 0)
    assert stuck.wait(PATIENCE_S)
    for n in range(1, 300):
        publisher.put(b"%04d" % n + bytes(100_000))
    go_on.set()


def test_lost_samples_are_repaired_in_order(join_zenoh: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_CHANNEL_SIZE", 1)
    inbox, misses = Inbox(), Inbox()
    lose_samples(join_zenoh, 300, inbox, misses)
    assert inbox.take(300) == [("net/report", b"%04d" % n) for n in range(300)]
    assert misses.rest() == []


def test_losses_beyond_the_cache_are_reported(join_zenoh: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_CHANNEL_SIZE", 1)
    inbox, misses = Inbox(), Inbox()
    lose_samples(join_zenoh, 1, inbox, misses)
    received: list[tuple[str, bytes]] = []
    while not received or received[-1][1] != b"0299":
        received += inbox.take(1)
    assert received == sorted(received)
    lost = 0
    while lost < 300 - len(received):
        ((key, count),) = misses.take(1)
        assert key == "net/report"
        lost += count
    assert lost == 300 - len(received) > 0


SLOW = 64_000.0


def test_display_data_beyond_a_known_rate_is_shed_and_counted_on_both_sides() -> None:
    inbox, misses, fence = Inbox(), Inbox(), Inbox()
    with open_zenoh(Network(listen=(ANY_PORT,), link_bit_s=SLOW)) as display:
        display.subscribe("net/*/plots", inbox, reliable=False, on_miss=misses)
        display.subscribe("net/fence", fence)
        display.announce("net/display")
        with open_zenoh(Network(connect=display.endpoints(), link_bit_s=SLOW)) as sensor:
            await_presence(sensor, "net/display")
            plots, reports = sensor.publisher("net/a/plots", reliable=False), sensor.publisher("net/fence")
            shed = []
            for n in range(4):
                shed.append(0)
                while not plots.put(b"%d" % n + bytes(9000)):
                    assert reports.put(b"report")
                    shed[-1] += 1
                    time.sleep(0.01)
            assert inbox.take(4) == [("net/a/plots", b"%d" % n + bytes(9000)) for n in range(4)]
    assert shed[0] == 0
    assert shed[-1] > 0
    assert misses.rest() == [("net/a/plots", number) for number in shed if number]
    assert len(fence.rest()) == sum(shed)


def test_display_data_lost_on_the_way_is_told_exactly(join_zenoh: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_CHANNEL_SIZE", 1)
    center, sensor = join_zenoh(), join_zenoh()
    stuck, go_on = threading.Event(), threading.Event()
    inbox, misses = Inbox(), Inbox()

    def deliver(key: str, payload: bytes) -> None:
        inbox(key, int(payload[:4]))
        stuck.set()
        assert go_on.wait(PATIENCE_S)

    center.subscribe("net/*", deliver, reliable=False, on_miss=misses)
    center.announce("net/center")
    await_presence(sensor, "net/center")
    publisher = sensor.publisher("net/plots", reliable=False)
    publisher.put(b"%04d" % 0)
    assert stuck.wait(PATIENCE_S)
    for n in range(1, 300):
        publisher.put(b"%04d" % n + bytes(100_000))
    go_on.set()
    received = [n for _, n in inbox.take(1)]
    for n in range(300, 10_000):
        publisher.put(b"%04d" % n)
        received += [n for _, n in inbox.rest()]
        if received[-1] >= 300:
            break
        time.sleep(0.01)
    center.close()
    received += [n for _, n in inbox.rest()]
    assert 0 < sum(n for _, n in misses.rest()) == received[-1] + 1 - len(received)


def test_a_failing_callback_is_logged_and_the_next_sample_comes(
    join_zenoh: Join, caplog: pytest.LogCaptureFixture
) -> None:
    bus, inbox = join_zenoh(), Inbox()

    def deliver(key: str, payload: bytes) -> None:
        inbox(key, 1 // len(payload))

    bus.subscribe("net/a", deliver)
    publisher = bus.publisher("net/a")
    publisher.put(b"")
    publisher.put(b"1")
    assert inbox.take(1) == [("net/a", 1)]
    assert "ZeroDivisionError" in caplog.text


def test_one_sensor_serves_two_listening_peers_without_duplicates() -> None:
    with ExitStack() as stack:
        center, watcher = [stack.enter_context(open_zenoh(Network(listen=(ANY_PORT,)))) for _ in range(2)]
        connect = center.endpoints() + watcher.endpoints()
        sensor = stack.enter_context(open_zenoh(Network(connect=connect)))
        inboxes = {center: Inbox(), watcher: Inbox()}
        for name, (bus, inbox) in zip("cw", inboxes.items(), strict=True):
            bus.subscribe("net/*", inbox, history=50)
            bus.watch("net/**", inbox)
            bus.announce(f"{name}/here")
        await_presence(sensor, "c/here", "w/here")
        sensor.announce("net/sensor/a")
        for inbox in inboxes.values():
            assert inbox.take(1) == [("net/sensor/a", True)]
        publisher = sensor.publisher("net/report")
        for n in range(100):
            publisher.put(b"%d" % n)
        for bus, inbox in inboxes.items():
            assert inbox.take(100) == [("net/report", b"%d" % n) for n in range(100)]
            bus.close()
            assert inbox.rest() == []


def test_a_peer_that_opens_first_finds_the_center_whenever_it_comes() -> None:
    endpoint, presence = free_endpoint(), Inbox()
    with open_zenoh(Network(connect=(endpoint,))) as sensor:
        sensor.watch("net/*", presence)
        publisher = sensor.publisher("net/report")
        for n in range(6):
            publisher.put(b"%d" % n)
        for _ in range(2):
            with open_zenoh(Network(listen=(endpoint,))) as center:
                reports = Inbox()
                center.subscribe("net/report", reports, history=4)
                center.announce("net/center")
                assert presence.take(1) == [("net/center", True)]
                assert reports.take(4) == [("net/report", b"%d" % n) for n in (2, 3, 4, 5)]
            assert presence.take(1) == [("net/center", False)]


def test_endpoints_are_the_actual_ones() -> None:
    fixed = free_endpoint()
    with open_zenoh(Network(listen=(ANY_PORT, fixed))) as bus:
        (any_port,) = {*bus.endpoints()} - {fixed}
        assert int(any_port.removeprefix("tcp/127.0.0.1:")) > 0
        for endpoint in bus.endpoints():
            with open_zenoh(Network(mode="client", connect=(endpoint,))):
                pass
    with open_zenoh(Network()) as bus:
        assert bus.endpoints() == ()


def test_a_fixed_port_leaves_the_administration_space_shut() -> None:
    fixed = free_endpoint()
    with open_zenoh(Network(listen=(fixed,))) as bus:
        assert bus.endpoints() == (fixed,)
        assert bus.ask("@/**", PATIENCE_S) == []


def test_a_taken_endpoint_is_named() -> None:
    with open_zenoh(Network(listen=(ANY_PORT,))) as bus:
        (taken,) = bus.endpoints()
        with pytest.raises(TransportError) as caught:
            open_zenoh(Network(listen=(ANY_PORT, taken)))
    assert str(caught.value) == (
        f"cannot listen on {taken}: address already in use; expected a free one (is another center or router running?)"
    )


def test_an_endpoint_of_another_machine_is_named() -> None:
    with pytest.raises(
        TransportError, match=r"^cannot listen on tcp/192\.0\.2\.77:7447: cannot assign requested address$"
    ):
        open_zenoh(Network(listen=("tcp/192.0.2.77:7447",)))


@pytest.mark.parametrize(
    "endpoint", ["127.0.0.1:7447", "tcp/127.0.0.1", "tcp/127.0.0.1:", "tcp/[::1:1", "tcp/a:65536", ""]
)
@pytest.mark.parametrize("side", ["listen", "connect"])
def test_a_malformed_endpoint_is_named(side: str, endpoint: str) -> None:
    with pytest.raises(TransportError) as caught:
        open_zenoh(Network.model_validate({side: (endpoint,)}))
    assert str(caught.value) == (
        f"network.{side}: {endpoint!r} is no endpoint: "
        "expected <tcp|udp|tls|quic>/<host>:<port>, such as tcp/127.0.0.1:7447"
    )


@pytest.mark.parametrize("endpoint", ["tcp/[::1]:7447", "tcp/radar-1.local:1#iface=lo", "tls/h:65535?prio=1"])
def test_well_formed_endpoints_pass(endpoint: str) -> None:
    with open_zenoh(Network(connect=(endpoint,))):
        pass


def test_nobody_connects_to_port_0() -> None:
    with pytest.raises(TransportError, match=r"^network\.connect: 'tcp/127\.0\.0\.1:0' is no endpoint"):
        open_zenoh(Network(connect=(ANY_PORT,)))


def test_a_client_without_an_endpoint_is_told() -> None:
    with pytest.raises(
        TransportError, match=r"^network\.connect: got no endpoint, expected at least one for a client$"
    ):
        open_zenoh(Network(mode="client"))


def test_a_client_that_nothing_answers_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "CONNECT_TIMEOUT_S", 0.2)
    one, two = free_endpoint(), free_endpoint()
    with pytest.raises(TransportError) as caught:
        open_zenoh(Network(mode="client", connect=(one, two)))
    message = str(caught.value)
    assert message.startswith(f"nothing answers at {one} or {two} within 0.")
    assert message.endswith(" s; is the router or center running?")


def test_a_client_waits_for_a_router_that_starts_later(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:

        def start_the_router(_: float) -> None:
            stack.enter_context(open_zenoh(Network(mode="router", listen=(endpoint,))))

        monkeypatch.setattr(time, "sleep", start_the_router)
        with open_zenoh(Network(mode="client", connect=(free_endpoint(), endpoint))) as client:
            assert client.endpoints() == ()


def test_closing_leaves_no_threads(join_zenoh: Join) -> None:
    before = threading.active_count()
    with join_zenoh() as bus:
        bus.subscribe("net/**", Inbox(), history=1, on_miss=Inbox())
        bus.watch("net/**", Inbox())
        bus.answer("net/a", bytes)
        assert threading.active_count() == before + 4
    assert threading.active_count() == before


def test_closing_amid_traffic_does_not_hang(join_zenoh: Join) -> None:
    center = join_zenoh()
    for _ in range(5):
        sensor, inbox = join_zenoh(), Inbox()
        sensor.subscribe("net/**", inbox, history=10, on_miss=Inbox())
        sensor.announce("net/sensor")
        publishers = [bus.publisher(f"net/{n}") for n, bus in enumerate([center, sensor])]

        def publish(publishers: list[Publisher] = publishers) -> None:
            with pytest.raises(TransportError, match="session closed"):
                while True:
                    for publisher in publishers:
                        publisher.put(bytes(1000))

        thread = threading.Thread(target=publish)
        thread.start()
        inbox.take(100)
        sensor.close()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


USE_EVERYTHING = """
import sys
from waldnet.common.config import Network
from waldnet.common.transport import open_zenoh
bus = open_zenoh(Network(listen=("tcp/127.0.0.1:0",), connect=tuple(sys.argv[1:])))
ignore = lambda *_: None
bus.subscribe("net/**", ignore, history=1, on_miss=ignore)
bus.subscribe("net/**", ignore, reliable=False)
bus.watch("net/**", ignore)
bus.answer("net/question", bytes)
bus.publisher("net/report").put(b"report")
bus.announce("net/child")
"""


def start(program: str, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-W", "error", "-c", program, *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("end", "code", "last_words"),
    [
        ("bus.close()", 0, ""),
        ("", 0, ""),
        ("1 / 0", 1, "ZeroDivisionError: division by zero"),
    ],
    ids=["closed", "forgotten", "error"],
)
def test_a_process_ends_even_if_it_forgets_to_close(end: str, code: int, last_words: str) -> None:
    with start(USE_EVERYTHING + end) as child:
        out, err = child.communicate(timeout=PATIENCE_S)
    assert (child.returncode, out) == (code, "")
    assert err.splitlines()[-1:] == [last_words][: bool(last_words)]


@pytest.mark.processes
def test_a_killed_process_is_missed() -> None:
    inbox = Inbox()
    with open_zenoh(Network(listen=(ANY_PORT,))) as center:
        center.watch("net/*", inbox)
        with start(USE_EVERYTHING + "import time; time.sleep(60)", *center.endpoints()) as child:
            try:
                assert inbox.take(1) == [("net/child", True)]
            finally:
                child.send_signal(signal.SIGKILL)
            child.communicate(timeout=PATIENCE_S)
        assert inbox.take(1) == [("net/child", False)]
