"""The Acme camera in smartcam's suite, and in tests of one's own."""

import contextlib
from collections.abc import AsyncIterator

import pytest
from acme_camera import ACME, RUNNING, AcmeCamera, measured

from smartcam import Camera
from smartcam.exceptions import FrameError, TriggerTimeoutError, UnsupportedError
from smartcam.protocols import messages as m
from smartcam.registry import PROTOCOLS
from smartcam.testing import (
    CameraKind,
    Conversation,
    LiveCamera,
    ProtocolSuite,
    Received,
    Sent,
    ThreadedCamera,
)

PROTOCOLS.register("acme", ACME)  # the entry point does it where the package is installed

CONNECT = (
    Sent(m.Connect(), b"HELLO\n"),
    Received(b"ACME\n", (m.ConnectAnswer(version=1),)),
)


class LiveAcme(LiveCamera):
    """An Acme camera for the suite."""

    def __init__(self, emulator: AcmeCamera) -> None:
        self.emulator = emulator

    @property
    def url(self) -> str:
        """Its address."""
        return f"{self.emulator.url}?dialect=lines"

    @property
    def has_session(self) -> bool:
        """Whether it serves a client."""
        return self.emulator.has_session


@contextlib.asynccontextmanager
async def put_up() -> AsyncIterator[LiveCamera]:
    """Put one up that counts."""
    async with AcmeCamera(parts=[str(number) for number in range(1000)]) as emulator:
        yield LiveAcme(emulator)


class TestAcme(ProtocolSuite):
    """Everything that the suite checks."""

    protocol = ACME
    conversations = (
        Conversation(
            name="a trigger",
            dialect="lines",
            steps=[
                *CONNECT,
                Sent(m.GetStatus(), b"STATE\n"),
                Received(b"run\n", (m.StatusReport(status=RUNNING),)),
                Sent(m.Query(), b"PROGRAM\n"),
                Received(b"7\n", (m.QueryAnswer(application=7),)),
                Sent(m.Trigger(), b"TRIGGER\n"),
                Received(b"12.5 bolt\n", (measured("12.5 bolt"),)),
            ],
        ),
        Conversation(
            name="nonsense", dialect="lines", steps=[*CONNECT, Received(b"what?\n", (FrameError,))]
        ),
    )
    camera_kinds = (
        CameraKind(
            name="Acme",
            open=put_up,
            applications=frozenset({LiveCamera.COUNTER}),
            numbers_with_sequence="n: uint32",
            raw_request=None,
            silent_request=None,
            exclusive=False,
        ),
    )


@pytest.mark.smartcam(
    protocol="acme", parts=["12.5 bolt"], interpret_as="x: real32 mm, name: string[10]"
)
@pytest.mark.asyncio
async def test_trigger_gives_what_was_measured(
    camera: Camera, emulated_camera: ThreadedCamera
) -> None:
    result = await camera.trigger()
    assert (result.application, result.value.x, result.value.name) == (7, 0.0125, "bolt")
    assert camera.capabilities.names == ["get_status"]
    with pytest.raises(UnsupportedError, match="dialect lines has no Stop; it can: get_status"):
        await camera.stop()
    emulated_camera.log.expect("Connect", "Trigger")


@pytest.mark.smartcam(protocol="acme", faults=[{"kind": "drop", "on": "Trigger"}])
@pytest.mark.asyncio
async def test_lost_trigger_is_an_error(camera: Camera) -> None:
    with pytest.raises(TriggerTimeoutError):
        await camera.trigger(timeout=0.2)
