"""The receive task: bounded work and memory, and nothing of the user's reaches the transport."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from camera_by_hand import READY, RUNNING
from clientkit import balance, by_hand, until
from handmade import CONNECT_ANSWER, OPENING, QUERY, RESULT, STATUS, Peer, scripted

import smartcam
from smartcam import InterpretationError, Status
from smartcam._client import handshake
from smartcam._client.link import LARGEST_CHUNK
from smartcam.observers import Observer

if TYPE_CHECKING:
    from smartcam import CameraEvent, Result, SmartCamera, SmartCamError
    from smartcam._client.link import TraceEntry

# ---------------------------------------------------------------------- what comes early


@pytest.mark.parametrize(
    ("begins", "step"),
    [
        (CONNECT_ANSWER, "waiting for the first status"),
        (CONNECT_ANSWER + STATUS, "waiting for the answer to Query"),
    ],
)
async def test_camera_that_floods_while_a_session_is_made_ends_the_attempt(
    begins: bytes, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handshake, "MAX_EARLY", 100_000)
    written: list[int] = []

    async def talk(peer: Peer, number: int) -> None:
        await peer.read(len(OPENING) if number == 0 else 12)
        peer.write(begins)
        written.append(0)
        while not peer.writer.is_closing():
            peer.write(RESULT * 1000)
            written[-1] += 1000 * len(RESULT)
            try:
                await peer.writer.drain()
            except ConnectionError:
                return

    async with scripted(talk) as listener:
        url = f"bvs://127.0.0.1:{listener.port}?dialect=handbook"
        camera = smartcam.connect(url, connect_attempts=2, max_length=50_000)
        with pytest.raises(smartcam.ConnectFailedError, match="before there was a session") as got:
            await camera.open()
    assert len(got.value.attempts) == 2
    assert all(step in attempt for attempt in got.value.attempts)
    assert "150000 are accepted" in got.value.attempts[0]


async def test_results_that_come_early_are_kept_up_to_the_bound() -> None:
    async def talk(peer: Peer, number: int) -> None:
        await peer.read(len(OPENING))
        peer.write(CONNECT_ANSWER + RESULT * 500 + STATUS)
        assert await peer.read(12) == QUERY
        peer.write(RESULT * 500 + bytes.fromhex("50535642 04000000 30000000 15000000"))
        await peer.rest()
        peer.close()

    async with scripted(talk) as listener:
        url = f"bvs://127.0.0.1:{listener.port}?dialect=handbook"
        camera = smartcam.connect(url)
        results = camera.results()
        async with camera:
            assert camera.statistics().received == 1000
            assert results.statistics().queued == 1000


# ---------------------------------------------------------------------- what users' code raises


class Rude(Observer):
    """Raises whatever it is told, at everything."""

    def __init__(self, kind: type[BaseException]) -> None:
        self.kind = kind

    def on_frame(self, entry: TraceEntry) -> None:
        raise self.kind

    def on_state(self, event: CameraEvent) -> None:
        raise self.kind

    def on_result(self, result: Result) -> None:
        raise self.kind

    def on_error(self, camera: str, error: SmartCamError, triggered_at: Any = None) -> None:
        raise self.kind


KINDS = pytest.mark.parametrize("kind", [ZeroDivisionError, asyncio.CancelledError])


@KINDS
async def test_observer_that_raises_disturbs_nothing(kind: type[BaseException]) -> None:
    async with by_hand(observers=[Rude(kind)], reconnect=None) as (_, camera):
        for _ in range(3):
            assert (await camera.trigger()).raw == b"found"
        assert camera.connected
        assert camera.statistics().sessions == 1


@KINDS
async def test_interpreter_that_raises_is_an_outcome(kind: type[BaseException]) -> None:
    def fail(reader: object) -> object:
        raise kind

    async with by_hand(interpret_as=fail, reconnect=None) as (_, camera):
        for _ in range(2):
            with pytest.raises(InterpretationError, match=kind.__name__):
                await camera.trigger()
        assert (await camera.trigger(interpret_as="raw")).raw == b"found"
        assert camera.statistics().sessions == 1


@KINDS
async def test_interpreter_of_a_burst_that_raises_is_an_error_in_the_stream(
    kind: type[BaseException],
) -> None:
    class Calibration:
        def to_robot(self, parts: list[Any]) -> list[Any]:
            raise kind

    async with by_hand(interpret_as="localizations", calibration=Calibration(), reconnect=None) as (
        box,
        camera,
    ):
        results = camera.results()
        part = b"a".ljust(50, b"\0") + bytes(4 * 5 - 1) + b"\x3f"
        box.send(box.result_frame(part) * 3)
        for _ in range(3):
            with pytest.raises(InterpretationError, match=kind.__name__):
                await anext(results)
        assert camera.connected
        balance(camera.statistics())


@KINDS
async def test_predicate_that_raises_tells_its_caller(kind: type[BaseException]) -> None:
    def fail(status: Status) -> bool:
        if status == Status.BUSY:
            raise kind
        return False

    async with by_hand(reconnect=None) as (box, camera):
        waiting = asyncio.create_task(camera.wait_status(fail))
        await asyncio.sleep(0)
        box.report(0x10, READY)
        with pytest.raises(kind):
            await waiting
        assert (await camera.trigger()).raw == b"found"
        assert camera.statistics().sessions == 1


# ---------------------------------------------------------------------- the account


async def test_account_balances_while_an_interpreter_runs() -> None:
    seen: list[int] = []
    cameras: list[SmartCamera] = []

    def look(reader: object) -> int:
        statistics = cameras[0].statistics()
        balance(statistics)
        seen.append(statistics.received)
        return 0

    async with by_hand(interpret_as=look) as (box, camera):
        cameras.append(camera)
        results = camera.results()
        await camera.trigger()
        box.send(box.result_frame() + box.status_frame(RUNNING) + box.result_frame())
        for _ in range(3):
            await anext(results)
        assert seen == [0, 1, 2]
        assert camera.statistics().received == 3


# ---------------------------------------------------------------------- fairness


async def test_flood_of_statuses_leaves_others_their_turns() -> None:
    """While one camera's statuses are worked off, the loop goes round many times."""
    async with by_hand() as (box, camera):
        turns = 0

        async def count() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        heard = camera.statistics().frames_received
        counting = asyncio.create_task(count())
        flood = box.status_frame(RUNNING) + box.status_frame(READY)
        box.send(flood * 5000)
        async with asyncio.timeout(60):
            while camera.statistics().frames_received < heard + 10_000:  # noqa: ASYNC110
                await asyncio.sleep(0)
        counting.cancel()
        assert turns > 10_000 / LARGEST_CHUNK
        await until(lambda: camera.status == Status(READY))
