"""Ends of the bus over Zenoh: opening, and a missing other side."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

import smartcam
from smartcam import _zenoh
from smartcam._zenoh import BusLink, with_ports
from smartcam.exceptions import ConnectFailedError, ConnectionLostError, ReservationLostError
from smartcam.fleet import FleetCamera
from smartcam.fleet._inside import ZenohConnection
from smartcam.models import Connected, Disconnected, Reconnected
from tests.client.clientkit import gone
from tests.fleet.fleetkit import FAST, LAYOUT, NAME, PATIENCE, NumberedCamera, Plant, until
from tests.fleet.inside import zenoh
from tests.fleet.partner import partner
from tests.handmade import refusing
from tests.processes import free_place, printed_by

MAX_DIRECT_BYTES = 64 << 10


pytestmark = pytest.mark.real_time

LONG_LEASE = {"transport/link/tx/lease": 3_600_000}
"""Of an end that takes nobody for gone because of silence."""


def port_of(place: str) -> int:
    return int(place.rpartition(":")[2])


@contextlib.asynccontextmanager
async def two_ends(**more: Any) -> AsyncIterator[tuple[ZenohConnection, ZenohConnection]]:
    """Give an end that listens, and one that has connected to it."""
    place = free_place()
    listens, connects = (
        ZenohConnection(BusLink(listen=(place,)), more),
        ZenohConnection(BusLink(connect=(place,))),
    )
    await listens.open(PATIENCE)
    try:
        await connects.open(PATIENCE)
        yield listens, connects
    finally:
        await connects.close()
        await listens.close()


class Heard:
    """The messages that came under a pattern."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []

    def __call__(self, key: str, payload: bytes) -> None:
        self.payloads.append(payload)

    async def come_all(self, payloads: list[bytes]) -> None:
        """Wait for all of some messages, in their order; one that was in doubt may come twice."""
        wanted = set(payloads)
        async with asyncio.timeout(PATIENCE):
            while not wanted <= {*self.payloads}:  # noqa: ASYNC110 - what another thread brings
                await asyncio.sleep(0.005)
        assert [*dict.fromkeys(one for one in self.payloads if one in wanted)] == payloads

    async def come(self, count: int) -> None:
        async with asyncio.timeout(PATIENCE):
            while len(self.payloads) < count:  # noqa: ASYNC110 - what another thread brings
                await asyncio.sleep(0.005)


async def heard_by(listens: ZenohConnection, connects: ZenohConnection) -> Heard:
    """Have one end hear what the other says, once they know of each other."""
    heard = Heard()
    connects.subscribe("test/**", heard)
    publisher = listens.publisher("test/first")
    async with asyncio.timeout(PATIENCE):
        while not publisher.has_subscribers:  # noqa: ASYNC110 - Zenoh calls nobody
            await asyncio.sleep(0.005)
    return heard


# ---------------------------------------------------------------------- what is open


def own_sockets(kind: str) -> Iterator[tuple[str, str, str]]:
    """Give local and remote address, and state, of this process' sockets of a kind."""
    inodes = set()
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            inodes.add(os.readlink(entry))  # noqa: PTH115 - what it says is no path
    for family in ("", "6"):
        for line in Path(f"/proc/self/net/{kind}{family}").read_text().splitlines()[1:]:
            fields = line.split()
            if f"socket:[{fields[9]}]" in inodes:
                yield fields[1], fields[2], fields[3]


LISTENS, ESTABLISHED = "0A", "01"
LOOPBACK = "0100007F"

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


@on_linux
async def test_nothing_listens_that_was_not_asked_for() -> None:
    before = {*own_sockets("tcp"), *own_sockets("udp")}
    async with two_ends() as (listens, _):
        after = {*own_sockets("tcp"), *own_sockets("udp")} - before
        listening = [local for local, _, state in after if state == LISTENS]
        assert listening == [f"{LOOPBACK}:{port_of(listens._link.listen[0]):04X}"]
        assert {*own_sockets("udp")} <= before  # no scouting
    await closed_sockets(before)


async def closed_sockets(before: set[tuple[str, str, str]]) -> None:
    """Wait until no connection is left that was not there before."""
    async with asyncio.timeout(PATIENCE):
        while {  # noqa: ASYNC110 - the system closes them
            one for one in own_sockets("tcp") if one[2] in {LISTENS, ESTABLISHED}
        } - before:
            await asyncio.sleep(0.01)


def test_engine_is_not_imported_without_a_fleet_over_it() -> None:
    said = printed_by(
        "import sys, asyncio, smartcam\n"
        "print('zenoh' in sys.modules)\n"
        "import smartcam.fleet\n"
        "print('zenoh' in sys.modules)\n"
        "from smartcam.fleet import FleetCamera, FleetServer\n"
        "print('numpy' in sys.modules)\n"
        "from smartcam.fleet import FleetFile\n"
        "file = FleetFile.model_validate({'cameras': {'line1/cam1': {'emulated': {}}}})\n"
        "async def main():\n"
        "    async with smartcam.fleet.open(file) as fleet:\n"
        "        await fleet['line1/cam1'].query_application()\n"
        "asyncio.run(main())\n"
        "print('zenoh' in sys.modules)\n"
    )
    assert said.split() == ["False"] * 4


# ---------------------------------------------------------------------- nobody there


async def test_nothing_there_is_told_at_once_with_its_place() -> None:
    with refusing(socket.SOCK_STREAM) as port:
        camera = smartcam.connect(f"fleet://127.0.0.1:{port}/{NAME}", connect_timeout=3600.0)
        async with asyncio.timeout(PATIENCE):
            error = await gone(camera.open())
    assert isinstance(error, ConnectFailedError)
    assert f"127.0.0.1:{port}" in str(error)
    assert error.port == port
    assert " at /" not in str(error)  # no place in the engine's source


@pytest.mark.parametrize("accepts", [True, False])
async def test_silent_host_is_given_up_by_the_timeout(accepts: bool) -> None:
    """One that takes connections and says nothing, and one that does not even take them."""
    with contextlib.ExitStack() as stack:
        silent = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        port = silent.getsockname()[1]
        for _ in range(0 if accepts else 4):
            filler = stack.enter_context(socket.socket())
            filler.setblocking(False)
            filler.connect_ex(("127.0.0.1", port))
        camera = smartcam.connect(f"fleet://127.0.0.1:{port}/{NAME}", connect_timeout=0.5)
        async with asyncio.timeout(PATIENCE):
            error = await gone(camera.open())
            assert isinstance(error, ConnectFailedError)
            assert f"127.0.0.1:{port}" in str(error)
            await asyncio.get_running_loop().shutdown_default_executor()


async def test_port_in_use_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        error = await gone(ZenohConnection(BusLink(listen=(place,))).open(PATIENCE))
        assert isinstance(error, ConnectFailedError)
        assert f"cannot listen on {place}" in str(error)


@pytest.mark.parametrize("host", ["192.0.2.1", "[2001:db8::1]", "nowhere.invalid"])
async def test_any_port_of_a_host_that_is_not_here_is_told(host: str) -> None:
    (place,) = with_ports([f"tcp/{host}:0"])
    error = await gone(ZenohConnection(BusLink(listen=(place,))).open(PATIENCE))
    assert isinstance(error, ConnectFailedError)
    assert f"cannot listen on {place}" in str(error)


@on_linux
async def test_open_that_is_cancelled_leaves_no_session() -> None:
    async with Plant(zenoh=True) as plant:
        before = {*own_sockets("tcp")}
        for delay in (0.0, 0.0, 0.001, 0.003, 0.01, 0.03):
            camera = plant.camera()
            task = asyncio.create_task(camera.open())
            await asyncio.sleep(delay)
            task.cancel()
            await asyncio.wait({task})
            if not task.cancelled():  # it was open by then
                await camera.close()
            await closed_sockets(before)
        async with plant.camera() as camera:
            assert (await camera.trigger(timeout=PATIENCE)).value.run == 1


# ---------------------------------------------------------------------- the other side goes


async def test_killed_agent_is_seen_at_once_and_everything_goes_on_when_it_is_back() -> None:
    """The same camera, and its subscriptions: nothing is to be made anew."""
    place = free_place()
    url = f"fleet://127.0.0.1:{port_of(place)}/{NAME}"
    async with NumberedCamera(time=0.01) as box, contextlib.AsyncExitStack() as stack:
        agent = await stack.enter_async_context(partner("agent", place, box.url))
        camera = await stack.enter_async_context(
            smartcam.connect(url, interpret_as=LAYOUT, reconnect=FAST)
        )
        events, results = camera.events(), camera.results()
        first = await camera.trigger(timeout=PATIENCE)
        assert await anext(results) == first
        other = await stack.enter_async_context(smartcam.connect(url, reconnect=FAST))
        assert isinstance(other, FleetCamera)
        reservation = other.reserve(timeout=PATIENCE)
        await reservation.__aenter__()
        waiting = [
            asyncio.create_task(camera.trigger(timeout=3600.0)),  # at the agent
            asyncio.create_task(camera.wait_status(_never, 3600.0)),  # here
        ]
        await camera.query_application()
        await agent.kill()
        async with asyncio.timeout(PATIENCE):
            for error in await asyncio.gather(*waiting, return_exceptions=True):
                assert isinstance(error, ConnectionLostError)
                assert "agent" in str(error)
            await until_not_connected(camera)
        assert isinstance(await gone(camera.trigger()), ConnectionLostError)
        await stack.enter_async_context(partner("agent", place, box.url))
        await camera.wait_connected(PATIENCE)
        second = await camera.trigger(timeout=PATIENCE)
        assert second.value.run == box.runs == 2
        async with asyncio.timeout(PATIENCE):
            assert await anext(results) == second
            kinds = [type(await anext(events)) for _ in range(events.statistics().queued)]
        wanted = {Connected, Disconnected, Reconnected}
        assert [kind for kind in kinds if kind in wanted] == [Disconnected, Reconnected]
        with pytest.raises(ReservationLostError):
            await reservation.__aexit__(None, None, None)


def _never(_: object) -> bool:
    return False


async def until_not_connected(camera: smartcam.Camera[Any]) -> None:
    while camera.connected:  # noqa: ASYNC110 - another process
        await asyncio.sleep(0.005)


async def test_reservation_of_a_killed_program_ends_without_any_lease() -> None:
    async with Plant(zenoh=True, engine=LONG_LEASE) as plant, plant.camera() as camera:
        async with partner("holder", plant.address.url) as holder:
            waiting = asyncio.create_task(camera.trigger(timeout=PATIENCE))
            await until_waits(plant)
            await holder.kill()
            assert (await waiting).value.run == 1
        assert plant.agent.shared_cameras[NAME].gate.holder is None


@pytest.mark.long
async def test_reservation_of_a_silent_program_ends_with_the_lease() -> None:
    async with (
        Plant(zenoh=True) as plant,
        plant.camera() as camera,
        partner("holder", plant.address.url) as holder,
    ):
        waiting = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        await until_waits(plant)
        holder.signal(signal.SIGSTOP)
        assert (await waiting).value.run == 1
        assert plant.agent.shared_cameras[NAME].gate.holder is None
        holder.signal(signal.SIGCONT)
        assert (await camera.trigger(timeout=PATIENCE)).value.run == 2


async def until_waits(plant: Plant) -> None:
    gate = plant.agent.shared_cameras[NAME].gate
    async with asyncio.timeout(PATIENCE):
        while not gate._queue:  # noqa: ASYNC110 - another process
            await asyncio.sleep(0.005)


# ---------------------------------------------------------------------- what is said


def lingering(port: int) -> int:
    """Count connections of this process that would be waited for when they are closed."""
    count = 0
    for place in Path("/dev/fd").iterdir():
        with contextlib.suppress(OSError):
            found = socket.socket(fileno=int(place.name))
            try:
                internet = found.family == socket.AF_INET
                if internet and port in {found.getsockname()[1], found.getpeername()[1]}:
                    count += found.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8)[0]
            finally:
                found.detach()
    return count


@pytest.mark.long
@pytest.mark.skipif(not Path("/dev/fd").is_dir(), reason="closing waits for nothing here")
async def test_no_connection_lingers_for_as_long_as_a_lease(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_zenoh, "_disable_linger", lambda _: None)
    async with two_ends() as (listens, _):
        port = port_of(listens._link.listen[0])
        assert lingering(port)  # as the engine makes them
        monkeypatch.undo()
        async with asyncio.timeout(PATIENCE):
            while lingering(port):  # noqa: ASYNC110 - what another thread does
                await asyncio.sleep(0.05)


@pytest.mark.parametrize("size", [0, 1, MAX_DIRECT_BYTES, MAX_DIRECT_BYTES + 1, 3 << 20])
async def test_what_is_said_arrives_however_long_it_is(size: int) -> None:
    payload = os.urandom(size)
    async with two_ends() as ends:
        for says, hears in (ends, ends[::-1]):
            heard = await heard_by(says, hears)
            says.put("test/it", payload)
            await heard.come_all([payload])
            assert {*heard.payloads} == {payload}


@pytest.mark.parametrize("count", [20, 100, 2000])
async def test_burst_is_not_dropped(count: int) -> None:
    """A program triggers many cameras in one turn of its loop, and all of them answer."""
    async with two_ends() as ends:
        for says, hears in (ends, ends[::-1]):
            heard = await heard_by(says, hears)
            payloads = [b"%d" % number + bytes(200) for number in range(count)]
            for payload in payloads:
                says.put("test/it", payload)
            await heard.come_all(payloads)


class Relay:
    """Connections to a place pass it, and stand still while it is told so.

    Args:
        place: endpoint that connections are passed on to.
    """

    def __init__(self, place: str) -> None:
        self.flows = asyncio.Event()
        self.flows.set()
        self._port = port_of(place)
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> str:
        self._server = await asyncio.start_server(self._pass_on, "127.0.0.1", 0)
        return f"tcp/127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _pass_on(self, *near: Any) -> None:
        far = await asyncio.open_connection("127.0.0.1", self._port)
        for reader, writer in ((near[0], far[1]), (far[0], near[1])):
            task = asyncio.create_task(self._pump(reader, writer))
            self._tasks.add(task)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(1 << 16):
                await self.flows.wait()
                writer.write(data)
                await writer.drain()
        finally:
            writer.close()


LOOP_MAY_WAIT = 0.5
"""Seconds; the link stands still for longer, and the loop waits a millisecond of its own."""


@pytest.mark.parametrize("urgent", [False, True])
async def test_what_is_said_while_a_link_stands_still_arrives_in_order(urgent: bool) -> None:
    """The engine drops what finds its buffers full; the loop is not held up for long by them."""
    place = free_place()
    listens, relay = ZenohConnection(BusLink(listen=(place,))), Relay(place)
    await listens.open(PATIENCE)
    async with relay as through:
        connects = await ZenohConnection(BusLink(connect=(through,))).open(PATIENCE)
        try:
            for says, hears in ((listens, connects), (connects, listens)):
                heard = await heard_by(says, hears)
                results = says.publisher("test/results", urgent=urgent)
                await until(lambda results=results: results.has_subscribers)
                relay.flows.clear()
                payloads = [b"%d" % number + bytes(200) for number in range(60)]
                for _ in range(300):  # much more than sockets take
                    results.put(bytes(65_000))
                slowest = 0.0
                for payload in payloads:
                    await asyncio.sleep(0.01)
                    begun = time.monotonic()
                    says.put("test/it", payload)
                    slowest = max(slowest, time.monotonic() - begun)
                assert slowest < LOOP_MAY_WAIT
                relay.flows.set()
                await heard.come_all(payloads)
                await until(
                    lambda says=says: not says._waiting_in_threads
                )  # the loop says it again itself
                assert (says._uncertain_count, says.waiting_bytes) == (0, 0)
                results.close()
        finally:
            await connects.close()
            await listens.close()


async def test_engine_thread_keeps_its_state_from_one_callback_to_the_next() -> None:
    """Python would make and free it for each message, which costs a third of a message."""
    own, calls = threading.local(), list[int]()

    def hear(_: Any) -> None:
        own.calls = getattr(own, "calls", 0) + 1
        calls.append(own.calls)

    async with two_ends() as (listens, connects):
        heard = await heard_by(listens, connects)
        session = connects._session
        subscriber = session.declare_subscriber("test/it", _zenoh.direct(hear))
        for count in range(20):
            listens.put("test/it", b"")
            await heard.come(count + 1)
        await until(lambda: len(calls) >= 20)  # one that was slow to go may come twice
        assert calls.count(1) <= 4  # threads that came for the first time
        subscriber.undeclare()


async def test_long_questions_and_answers_arrive() -> None:
    async with two_ends() as (one, other):
        question, answers = os.urandom(1 << 20), [os.urandom(1 << 20) for _ in range(3)]

        def answer(asked: Any) -> None:
            assert asked.payload == question
            for number, payload in enumerate(answers):
                asked.reply(f"test/{number}", payload)
            asked.close()

        one.answer("test/*", answer)
        got: list[tuple[str, bytes]] = []
        async with asyncio.timeout(PATIENCE):
            while len(got) < 3:
                got = await other.ask("test/**", question, PATIENCE)
        assert got == [(f"test/{number}", payload) for number, payload in enumerate(answers)]


async def test_callback_that_raises_harms_nobody(caplog: pytest.LogCaptureFixture) -> None:
    async with two_ends() as (says, hears):

        def fail(*_: object) -> None:
            raise ZeroDivisionError

        hears.subscribe("test/**", fail)
        heard = await heard_by(says, hears)
        hears.watch("presence/**", fail)
        with caplog.at_level(logging.ERROR, "smartcam.fleet"):
            for number in range(100):
                says.put("test/it", b"%d" % number)
            says.announce("presence/one")
            await heard.come_all([b"%d" % number for number in range(100)])
        assert any("was not handled" in record.message for record in caplog.records)
        caplog.clear()


async def test_what_waits_for_a_loop_that_is_busy_is_bounded(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bound, size, count = 100_000, 1000, 1000
    monkeypatch.setattr(_zenoh, "MAX_WAITING_BYTES", bound)
    async with two_ends() as (says, hears):
        heard = await heard_by(says, hears)
        session, done = says._session, threading.Event()

        def waiting() -> int:
            return hears._queued_bytes - hears._handled_bytes

        def say() -> None:
            for _ in range(count):
                session.put(
                    "test/it",
                    bytes(size),
                    congestion_control=importlib.import_module("zenoh").CongestionControl.BLOCK,
                )
            done.set()

        with caplog.at_level(logging.WARNING, "smartcam.fleet"):
            thread = threading.Thread(target=say)
            thread.start()
            assert done.wait(PATIENCE)  # the loop does nothing else meanwhile
            thread.join()
            deadline = time.monotonic() + PATIENCE
            while waiting() <= bound - size and time.monotonic() < deadline:
                time.sleep(0.01)  # noqa: ASYNC251 - that it does not run is the point
        assert bound - size < waiting() <= bound
        await heard.come(bound // size)
        assert any("does not read" in record.message for record in caplog.records)
        caplog.clear()
        async with asyncio.timeout(PATIENCE):
            while heard.payloads[-1] != b"last":  # as soon as it reads again, all is well
                says.put("test/last", b"last")
                await asyncio.sleep(0.05)
        await until(lambda: not waiting())  # of another last one
        assert heard.payloads.count(bytes(size)) < count


@pytest.mark.parametrize("idle", [0.0, 60.0])
async def test_keys_that_are_used_again_have_publishers_within_a_bound(
    idle: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh, "MAX_FREQUENT_KEYS", 2)
    monkeypatch.setattr(zenoh, "IDLE_KEY_TIMEOUT", idle)
    async with two_ends() as (hears, says):
        heard = await heard_by(says, hears)
        before, sent = len(says._declared), list[bytes]()
        for number in range(40):
            sent.append(b"%d" % number)
            says.put(f"test/{number // 4 % 5}", sent[-1])
            await asyncio.sleep(0.011)  # each by itself
        await heard.come_all(sent)
        assert set(says._frequent_keys) == (
            {"test/3", "test/4"} if idle == 0 else {"test/0", "test/1"}
        )
        assert len(says._declared) == before + 2
        assert all(one.use_publisher(0.0) is not None for one in says._frequent_keys.values())


async def test_end_that_is_closed_says_and_hears_nothing_and_can_be_closed_again() -> None:
    async with two_ends() as (says, hears):
        heard = await heard_by(says, hears)
        publisher = hears.publisher("test/it")
        await hears.close()
        await hears.close()
        says.put("test/it", b"1")
        hears.put("test/it", b"2")
        publisher.put(b"3")
        publisher.close()
        assert await hears.ask("test/**", b"", 1.0) == []
        await asyncio.sleep(0.1)
        assert heard.payloads == []


async def test_program_hears_why_a_camera_is_shared_no_more_before_its_presence_ends() -> None:
    async with Plant(zenoh=True) as plant, plant.camera() as camera:
        await camera.trigger()
        await plant.agent.unshare(NAME, "it is told to")
        await until(lambda: not camera.connected)
        assert "the agent agent shares the camera no more: it is told to" in str(camera.trouble)


CANCELLED_WHILE_IT_OPENS = """
import asyncio
from smartcam._zenoh import BusLink
from smartcam.fleet._bus.zenoh import ZenohConnection

async def main():
    opening = asyncio.create_task(ZenohConnection(BusLink(connect=({place!r},))).open(10.0))
    await asyncio.sleep({wait})
    opening.cancel()
    await asyncio.wait({{opening}})

asyncio.run(main())
print("ended")
"""


@pytest.mark.parametrize(
    "steps", [range(1, 10, 8), pytest.param(range(10), marks=pytest.mark.long)]
)
async def test_program_that_ends_while_its_bus_opens_is_not_aborted(steps: range) -> None:
    """The engine's session comes when nobody wants it; its close once ran into Python's end."""
    place = free_place()
    listens = await ZenohConnection(BusLink(listen=(place,))).open(PATIENCE)
    try:
        for step in steps:
            text = CANCELLED_WHILE_IT_OPENS.format(place=place, wait=0.003 * step)
            assert await asyncio.to_thread(printed_by, text) == "ended\n"
    finally:
        await listens.close()


# ---------------------------------------------------------------------- what is patient


async def test_flood_of_what_is_patient_neither_delays_nor_fills_up_all_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A viewer's questions are: a command that comes behind thousands of them is next."""
    async with two_ends() as (listens, connects):
        came: list[str] = []
        ended = asyncio.Event()

        def hear(key: str, _: bytes) -> None:
            came.append(key)
            if key == "last":
                ended.set()

        for pattern, patient in (("ask/*", True), ("command", False), ("last", False)):
            listens.subscribe(pattern, hear, low_priority=patient)
        for number in range(2000):
            listens.call_in_loop_later(hear, 10, f"ask/{number}", b"")
        listens.call_in_loop(hear, 10, "command", b"")
        await until(lambda: len(came) == 2001)
        assert came[0] == "command"
        assert came[1:] == [f"ask/{number}" for number in range(2000)]  # in their order

        monkeypatch.setattr(_zenoh, "MAX_WAITING_BYTES", 1000)
        listens.call_in_loop_later(hear, 990, "ask/x", b"")
        assert listens.full(20, later=True)
        assert not listens.full(20)
        connects.put("last", b"")
        async with asyncio.timeout(PATIENCE):
            await ended.wait()


async def test_each_question_waits_as_its_key_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_zenoh, "MAX_WAITING_BYTES", 10_000)
    async with two_ends() as (listens, connects):

        def answer(question: Any) -> None:
            question.reply(question.key, b"yes")
            question.close()

        listens.answer("q/*", answer, low_priority=lambda key: key.endswith("look"))
        assert await connects.ask("q/look", b"", PATIENCE) == [("q/look", b"yes")]
        with listens._lock:
            listens._queued_later_bytes += 10_000  # as if so much waited
        assert await connects.ask("q/look", b"", PATIENCE) == []
        assert await connects.ask("q/do", b"", PATIENCE) == [("q/do", b"yes")]
        assert await connects.ask("q/do", bytes(20_000), PATIENCE) == []
        with listens._lock:
            listens._queued_later_bytes -= 10_000
        assert await connects.ask("q/look", b"", PATIENCE) == [("q/look", b"yes")]
