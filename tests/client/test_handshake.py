"""Making a session, against cameras written by hand: good, slow, silent and broken ones."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import pytest

from smartcam._client._inside import Attempt, Session
from smartcam.exceptions import (
    ConfigurationError,
    ConnectFailedError,
    FrameError,
    PluginError,
    RemoteProtocolError,
)
from smartcam.models import Status
from smartcam.observers import RawFrame
from smartcam.protocols import BVS, State
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, Event, load_protocol
from smartcam.registry import PROTOCOLS
from smartcam.settings import CameraSettings
from tests.client.inside import establish, handshake
from tests.handmade import (
    BUSY,
    CONNECT,
    CONNECT_ANSWER,
    DISCONNECT,
    HOST,
    LIMIT,
    OPENING,
    QUERY,
    QUERY_ANSWER,
    RESULT,
    STATUS,
    THESIS_CONNECT_ANSWER,
    THESIS_OPENING,
    THESIS_QUERY,
    THESIS_QUERY_ANSWER,
    THESIS_STATUS,
    Peer,
    datagrams,
    refusing,
    scripted,
    until,
)
from tests.machines import THESIS

RUNNING = m.StatusReport(status=Status(0x280))
ANSWERS = [m.ConnectAnswer(version=1), RUNNING, m.QueryAnswer(application=21)]
BOMB = bytes.fromhex("50535642 ffffffff 01000000")


def settings(port: int, query: str = "?dialect=handbook", **options: Any) -> CameraSettings:
    scheme = options.pop("scheme", "bvs")
    options = {"name": "cell 1", "connect_timeout": LIMIT, **options}
    return CameraSettings.make(f"{scheme}://{HOST}:{port}{query}", None, options)


@contextlib.asynccontextmanager
async def session_with(
    talk: Callable[[Peer, int], Awaitable[None]], query: str = "?dialect=handbook", **options: Any
) -> AsyncIterator[Session]:
    """Make a session with a camera that talks like this; end it in order."""
    async with scripted(talk) as listener:
        session = await establish(settings(listener.port, query, **options))
        try:
            yield session
        finally:
            await session.link.close(LIMIT)


async def failure_with(
    talk: Callable[[Peer, int], Awaitable[None]], query: str = "?dialect=handbook", **options: Any
) -> ConnectFailedError:
    """Return the error of a session that cannot be made."""
    async with scripted(talk) as listener:
        with pytest.raises(ConnectFailedError) as caught:
            await establish(settings(listener.port, query, **options))
        error = caught.value
        assert (error.host, error.port) == (HOST, listener.port)
        begin = f"cell 1: no session with bvs://{HOST}:{listener.port}{query}: "
        assert str(error).startswith(begin)
        return error


async def answer(peer: Peer, connect_answer: bytes = CONNECT_ANSWER + STATUS) -> None:
    """Be a good camera to the end."""
    assert await peer.read(24) == OPENING
    peer.write(connect_answer)
    assert await peer.read(12) == QUERY
    peer.write(QUERY_ANSWER)
    await end(peer)


async def end(peer: Peer) -> None:
    """Wait for the client's end, then end too."""
    await peer.rest()
    peer.close()


async def good(peer: Peer, number: int) -> None:
    await answer(peer)


async def silent(peer: Peer, number: int) -> None:
    await end(peer)


def events(session: Session) -> list[Event]:
    return [event for chunk in session.early_chunks for event in chunk.events]


# ---------------------------------------------------------------------- a session


async def test_establish_good_camera_gives_a_session() -> None:
    async with session_with(good) as session:
        assert session.dialect is HANDBOOK
        assert session.version == 1
        assert session.address.dialect == "handbook"
        assert session.link.machine.state is State.CONNECTED
        assert events(session) == ANSWERS


async def test_establish_pins_the_dialect_that_was_found() -> None:
    async with session_with(good, query="") as session:
        port = session.address.port
        assert session.address.url == f"bvs://{HOST}:{port}?dialect=handbook"


async def test_establish_keeps_everything_that_came_meanwhile() -> None:
    async def talk(peer: Peer, number: int) -> None:
        await peer.read(24)
        peer.write(CONNECT_ANSWER + RESULT + BUSY + STATUS)
        assert await peer.read(12) == QUERY
        peer.write(RESULT + STATUS + QUERY_ANSWER + RESULT)
        await end(peer)

    async with session_with(talk) as session:
        container = m.ResultContainer(application=21, data=b"Hello")
        busy = m.StatusReport(status=Status.BUSY)
        assert events(session) == [
            *(m.ConnectAnswer(version=1), container, busy, RUNNING),
            *(container, RUNNING, m.QueryAnswer(application=21), container),
        ]


async def test_establish_unknown_message_is_kept_and_no_error() -> None:
    async def talk(peer: Peer, number: int) -> None:
        unknown = bytes.fromhex("50535642 01000000 77000000 ff")
        await answer(peer, CONNECT_ANSWER + unknown + STATUS)

    async with session_with(talk) as session:
        assert m.UnknownMessage(message_id=0x77, payload=b"\xff") in events(session)


async def test_establish_answer_in_single_bytes_is_understood() -> None:
    async def talk(peer: Peer, number: int) -> None:
        await peer.read(24)
        for byte in CONNECT_ANSWER + STATUS:
            peer.write(bytes([byte]))
            await peer.writer.drain()
            await asyncio.sleep(0)
        await peer.read(12)
        peer.write(QUERY_ANSWER)
        await end(peer)

    async with session_with(talk) as session:
        assert events(session) == ANSWERS


async def test_establish_unasked_query_answer_does_not_stand_for_the_asked_one() -> None:
    async def talk(peer: Peer, number: int) -> None:
        other = bytes.fromhex("50535642 04000000 30000000 63000000")
        await answer(peer, CONNECT_ANSWER + other + STATUS)

    async with session_with(talk) as session:
        assert events(session) == ANSWERS
        assert session.link.machine.counters.unexpected_messages == 1


async def test_establish_newer_version_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    async def talk(peer: Peer, number: int) -> None:
        await answer(peer, bytes.fromhex("50535642 04000000 01000000 02000000") + STATUS)

    async with session_with(talk) as session:
        assert session.version == 2
    assert [record.getMessage() for record in caplog.records] == [
        "cell 1 ! protocol version 2 is newer than 1"
    ]


async def test_establish_hands_the_trace_every_frame() -> None:
    frames: list[RawFrame] = []
    async with scripted(good) as listener:
        session = await establish(settings(listener.port), frames.extend)
        await session.link.close(LIMIT)
    entries = [one.entry() for one in frames]
    assert [(entry.direction, entry.message) for entry in entries] == [
        (">", "Disconnect"),
        (">", "Connect"),
        ("<", "ConnectAnswer"),
        ("<", "StatusReport"),
        (">", "Query"),
        ("<", "QueryAnswer"),
        (">", "Disconnect"),
    ]


# ---------------------------------------------------------------------- one bad attempt, then good


def then_good(
    bad: Callable[[Peer], Awaitable[None]], bad_ones: int = 1
) -> tuple[list[int], Callable[[Peer, int], Awaitable[None]]]:
    """Return the list of connections seen, and a camera that is bad at the first ones."""
    seen: list[int] = []

    async def talk(peer: Peer, number: int) -> None:
        seen.append(number)
        if number <= bad_ones:
            await bad(peer)
        else:
            await answer(peer)

    return seen, talk


@pytest.mark.parametrize(
    "reply",
    [
        STATUS,
        STATUS + CONNECT_ANSWER,
        QUERY_ANSWER,
        b"garbage",
        BOMB,
        bytes.fromhex("50535642 04000000 01000000 00000000"),
        bytes.fromhex("50535642 02000000 01000000 0100"),
        THESIS_CONNECT_ANSWER,
        CONNECT_ANSWER + b"garbage",
        CONNECT_ANSWER + CONNECT_ANSWER,
        OPENING,
    ],
    ids=[
        *("status only", "status first", "answer to Query", "garbage", "4 GiB", "version 0"),
        *("short", "other dialect", "garbage after", "twice", "echo"),
    ],
)
async def test_establish_anything_unexpected_leads_to_a_fresh_link(reply: bytes) -> None:
    async def bad(peer: Peer) -> None:
        await peer.read(24)
        peer.write(reply)
        await peer.rest()

    seen, talk = then_good(bad)
    async with session_with(talk) as session:
        assert seen == [1, 2]
        assert events(session) == ANSWERS


async def test_establish_peer_that_closes_or_resets_leads_to_a_fresh_link() -> None:
    async def bad(peer: Peer) -> None:
        await peer.read(24)
        peer.write(CONNECT_ANSWER[:7])
        if next(ends):
            peer.close()
        else:
            peer.reset()

    ends = iter([True, False])
    seen, talk = then_good(bad, bad_ones=2)
    async with session_with(talk, connect_attempts=3) as session:
        assert seen == [1, 2, 3]
        assert events(session) == ANSWERS


async def test_establish_camera_that_hangs_up_at_disconnect_gets_none_the_next_time() -> None:
    async def talk(peer: Peer, number: int) -> None:
        if await peer.read(12) == DISCONNECT:
            peer.close()
            return
        peer.write(CONNECT_ANSWER + STATUS)
        assert await peer.read(12) == QUERY
        peer.write(QUERY_ANSWER)
        await end(peer)

    async with session_with(talk) as session:
        assert session.version == 1


async def test_establish_answers_only_at_the_third_attempt() -> None:
    seen, talk = then_good(end, bad_ones=2)
    async with session_with(talk, connect_timeout=0.4, connect_attempts=3) as session:
        assert seen == [1, 2, 3]
        assert events(session) == ANSWERS


async def test_establish_attempt_that_fails_says_disconnect_in_a_session() -> None:
    last: asyncio.Queue[bytes] = asyncio.Queue()

    async def bad(peer: Peer) -> None:
        assert await peer.read(24) == OPENING
        peer.write(CONNECT_ANSWER)
        last.put_nowait(await peer.rest())

    _, talk = then_good(bad)
    async with session_with(talk, connect_timeout=0.2, connect_attempts=2):
        assert await asyncio.wait_for(last.get(), LIMIT) == DISCONNECT


# ---------------------------------------------------------------------- no session at all


async def test_establish_silence_names_each_attempt_and_keeps_the_timeout() -> None:
    loop = asyncio.get_running_loop()
    start = loop.time()
    error = await failure_with(silent, connect_timeout=0.3, connect_attempts=3)
    assert 0.28 < loop.time() - start < 1.5
    assert error.attempts == tuple(
        f"attempt {number}: handbook over TCP: waiting for the answer to Connect: silence for 0.1 s"
        for number in (1, 2, 3)
    )
    assert isinstance(error.__cause__, TimeoutError)


async def test_establish_unpinned_silence_takes_turns_through_the_dialects() -> None:
    error = await failure_with(silent, query="", connect_timeout=0.3, connect_attempts=2)
    dialects = [one.partition(": ")[2].partition(" over")[0] for one in error.attempts]
    assert dialects == 2 * ["b16 or bid", "handbook", "thesis"]


async def test_establish_unpinned_dialect_that_answered_is_the_only_one_tried_again() -> None:
    async def talk(peer: Peer, number: int) -> None:
        if await peer.read(24) == THESIS_OPENING:
            peer.write(THESIS_CONNECT_ANSWER)
        await end(peer)

    error = await failure_with(talk, query="", connect_timeout=0.4, connect_attempts=3)
    dialects = [one.partition(": ")[2].partition(" over")[0] for one in error.attempts]
    assert dialects == ["b16 or bid", "handbook", "thesis", "thesis", "thesis"]


@pytest.mark.parametrize(
    ("reply", "outcome"),
    [
        (CONNECT_ANSWER, "waiting for the first status: 16 bytes, then silence for 0.1 s"),
        (
            CONNECT_ANSWER + STATUS,
            "waiting for the answer to Query: 36 bytes, then silence for 0.1 s",
        ),
        (CONNECT_ANSWER[:5], "waiting for the answer to Connect: 5 bytes, then silence for 0.1 s"),
    ],
)
async def test_establish_silence_in_the_middle_tells_how_far_it_came(
    reply: bytes, outcome: str
) -> None:
    async def talk(peer: Peer, number: int) -> None:
        await peer.read(24)
        peer.write(reply)
        await end(peer)

    error = await failure_with(talk, connect_timeout=0.1, connect_attempts=1)
    assert error.attempts == (f"attempt 1: handbook over TCP: {outcome}",)


@pytest.mark.parametrize(
    ("reply", "outcome", "cause"),
    [
        (b"HTTP", "wrong magic number: 48 54 54 50 came, 50 53 56 42 was expected", FrameError),
        (BOMB, "announces 4294967295 bytes of payload", FrameError),
        (STATUS, "StatusReport (0x12) came in state connecting", RemoteProtocolError),
        (
            bytes.fromhex("50535642 04000000 01000000 00000000"),
            "the camera speaks protocol version 0",
            RemoteProtocolError,
        ),
    ],
)
async def test_establish_broken_answer_is_named_in_each_attempt(
    reply: bytes, outcome: str, cause: type[Exception]
) -> None:
    async def talk(peer: Peer, number: int) -> None:
        await peer.read(24)
        peer.write(reply)
        await peer.rest()

    error = await failure_with(talk, connect_attempts=2)
    assert len(error.attempts) == 2
    for text in error.attempts:
        assert "handbook over TCP: waiting for the answer to Connect: " in text
        assert outcome in text
    assert isinstance(error.__cause__, cause)


@pytest.mark.parametrize(
    ("reply", "outcome"),
    [
        (b"", "the other side closed the connection"),
        (
            CONNECT_ANSWER[:7],
            "the other side closed the connection in the middle of a frame (7 bytes of it)",
        ),
    ],
)
async def test_establish_peer_that_closes_is_named(reply: bytes, outcome: str) -> None:
    async def talk(peer: Peer, number: int) -> None:
        await peer.read(24)
        peer.write(reply)
        peer.close()

    error = await failure_with(talk, connect_attempts=1)
    assert error.attempts[0].endswith(f"waiting for the answer to Connect: {outcome}")


async def test_establish_peer_that_closes_at_once_is_no_session() -> None:
    async def talk(peer: Peer, number: int) -> None:
        peer.close()

    error = await failure_with(talk, connect_attempts=2)
    assert len(error.attempts) == 2
    assert isinstance(error.__cause__, (RemoteProtocolError, ConnectionError))


async def test_establish_nothing_listens_fails_at_once_after_one_try_a_round() -> None:
    with refusing(socket.SOCK_STREAM) as port, pytest.raises(ConnectFailedError) as caught:
        await establish(settings(port, "", connect_attempts=2))
    assert len(caught.value.attempts) == 2
    assert caught.value.attempts[1].startswith("attempt 2: b16 or bid over TCP: opening the link: ")
    assert isinstance(caught.value.__cause__, ConnectionRefusedError)


async def test_establish_length_above_the_clients_own_limit_is_refused() -> None:
    async def talk(peer: Peer, number: int) -> None:
        await peer.read(24)
        peer.write(CONNECT_ANSWER + bytes.fromhex("50535642 11000000 20000000"))
        await peer.rest()

    error = await failure_with(talk, connect_attempts=1, max_length=16)
    assert "announces 17 bytes of payload; 0 to 16 are accepted" in error.attempts[0]


async def test_establish_each_attempt_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, logger="smartcam.handshake")
    error = await failure_with(silent, connect_timeout=0.1, connect_attempts=1)
    assert [record.getMessage() for record in caplog.records] == [f"cell 1 ! {error.attempts[0]}"]


# ---------------------------------------------------------------------- finding the dialect


async def thesis_camera(peer: Peer, number: int) -> None:
    """Ignore what does not begin with its magic number, as the documents say."""
    if await peer.read(24) == THESIS_OPENING:
        peer.write(THESIS_CONNECT_ANSWER + THESIS_STATUS)
        assert await peer.read(12) == THESIS_QUERY
        peer.write(THESIS_QUERY_ANSWER)
    await end(peer)


async def test_establish_thesis_camera_is_found_from_an_unpinned_url(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(handshake, "DETECTION_TIMEOUT", 0.05)
    loop = asyncio.get_running_loop()
    start = loop.time()
    async with session_with(thesis_camera, query="") as session:
        assert loop.time() - start < 1.0
        assert session.dialect is THESIS
        assert session.address.url.endswith("?dialect=thesis")
        assert events(session)[-1] == m.QueryAnswer(application=3)


async def test_establish_pinned_dialect_tries_no_other() -> None:
    error = await failure_with(thesis_camera, connect_timeout=0.1, connect_attempts=2)
    assert all("handbook over TCP" in text for text in error.attempts)
    async with session_with(thesis_camera, query="?dialect=thesis") as session:
        assert session.dialect is THESIS


async def test_establish_first_round_is_short_and_later_ones_share_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(handshake, "DETECTION_TIMEOUT", 0.02)
    error = await failure_with(silent, query="", connect_timeout=0.7, connect_attempts=2)
    waited = [text.rpartition(" for ")[2] for text in error.attempts]
    seconds = [float(text.split()[0]) * {"ms": 0.001, "s": 1.0}[text.split()[1]] for text in waited]
    assert len(seconds) == 6
    assert max(seconds[:3]) < min(seconds[3:])  # 0.02 and 0.2, and what a loaded machine adds


# ---------------------------------------------------------------------- cancelling


async def test_establish_cancelled_drops_the_link() -> None:
    ended = asyncio.Event()

    async def talk(peer: Peer, number: int) -> None:
        assert await peer.read(24) == OPENING
        reached.set()
        assert await peer.rest() == DISCONNECT
        ended.set()

    reached = asyncio.Event()
    async with scripted(talk) as listener:
        task = asyncio.create_task(establish(settings(listener.port)))
        async with asyncio.timeout(LIMIT):
            await reached.wait()
            task.cancel()
            await asyncio.wait({task})
            assert task.cancelled()
            await ended.wait()


# ---------------------------------------------------------------------- UDP


def udp_camera(data: bytes) -> list[bytes]:
    return {CONNECT: [CONNECT_ANSWER, STATUS], QUERY: [QUERY_ANSWER]}.get(data, [])


async def test_establish_udp_gives_a_session_of_datagrams() -> None:
    async with datagrams(udp_camera) as camera:
        session = await establish(settings(camera.port, scheme="bvs+udp"))
        assert events(session) == ANSWERS
        assert session.address.url == f"bvs+udp://{HOST}:{camera.port}?dialect=handbook"
        await session.link.close(LIMIT)
        await until(lambda: len(camera.received) == 4)
        assert camera.received == [DISCONNECT, CONNECT, QUERY, DISCONNECT]


async def test_establish_udp_garbage_is_ignored_and_the_answer_taken() -> None:
    def talk(data: bytes) -> list[bytes]:
        return [b"garbage", BOMB, STATUS, *udp_camera(data)]

    async with datagrams(talk) as camera:
        session = await establish(settings(camera.port, scheme="bvs+udp", connect_attempts=1))
        assert events(session)[0] == m.ConnectAnswer(version=1)
        assert session.link.machine.counters.ignored_frames >= 3
        await session.link.close(LIMIT)


async def test_establish_udp_silence_and_garbage_name_what_came() -> None:
    async with datagrams(lambda data: [b"noise"]) as camera:
        with pytest.raises(ConnectFailedError) as caught:
            await establish(
                settings(camera.port, scheme="bvs+udp", connect_timeout=0.1, connect_attempts=1)
            )
    assert caught.value.attempts == (
        "attempt 1: handbook over UDP: waiting for the answer to Connect: "
        "10 bytes, then silence for 0.1 s",
    )


async def test_establish_udp_refused_port_is_named() -> None:
    with refusing(socket.SOCK_DGRAM) as port, pytest.raises(ConnectFailedError) as caught:
        await establish(settings(port, scheme="bvs+udp", connect_attempts=1))
    assert "Connection refused" in caught.value.attempts[0]


async def test_establish_udp_thesis_camera_is_found_with_a_fresh_socket(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(handshake, "DETECTION_TIMEOUT", 0.05)

    def talk(data: bytes) -> list[bytes]:
        connect = THESIS_OPENING[12:]
        replies = {connect: [THESIS_CONNECT_ANSWER, THESIS_STATUS], THESIS_QUERY: [
            THESIS_QUERY_ANSWER
        ]}  # fmt: skip
        return replies.get(data, [])

    async with datagrams(talk) as camera:
        session = await establish(settings(camera.port, "", scheme="bvs+udp"))
        assert session.dialect is THESIS
        assert len(camera.clients) == 3
        await session.link.close(LIMIT)


async def test_establish_udp_late_attempt_is_answered_on_its_own_socket() -> None:
    seen: list[bytes] = []

    def talk(data: bytes) -> list[bytes]:
        seen.append(data)
        return udp_camera(data) if seen.count(CONNECT) == 3 else []

    async with datagrams(talk) as camera:
        chosen = settings(camera.port, scheme="bvs+udp", connect_timeout=0.4, connect_attempts=3)
        session = await establish(chosen)
        assert len(camera.clients) == 3
        await session.link.close(LIMIT)


# ---------------------------------------------------------------------- protocols


def test_load_protocol_gives_the_protocol() -> None:
    assert load_protocol("bvs") is BVS


def test_load_protocol_unknown_name_is_a_plugin_error() -> None:
    with pytest.raises(PluginError, match="'acme' is unknown; known are bvs"):
        load_protocol("acme")


def test_load_protocol_entry_point_that_gives_something_else_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(PROTOCOLS._loaded, "acme", 42)
    with pytest.raises(ConfigurationError) as caught:
        load_protocol("acme")
    assert str(caught.value) == "entry point 'acme' gives 42, not a Protocol"


def test_try_is_one_line() -> None:
    tried = Attempt("handbook", "tcp", outcome="silence")
    assert str(tried) == "handbook over TCP: opening the link: silence"
