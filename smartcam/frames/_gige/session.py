"""Control one camera: read its description, set its features, send heartbeats."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final, cast

from smartcam.exceptions import FrameSourceError, FrameTimeoutError, MessageError
from smartcam.frames._gige.control import ControlChannel, RequestRefusedError, heartbeat
from smartcam.frames._gige.description import locate, parse, unpack
from smartcam.frames._gige.event_channel import EventChannel
from smartcam.frames._gige.features import GenicamFeatures
from smartcam.frames._gige.gvcp import CONTROL, EXCLUSIVE, LATCH, GvcpStatus, Register, text
from smartcam.frames._gige.messages import MessageFeatures, cut_chunks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from smartcam.frames._features import FeatureValue
    from smartcam.frames._gige.block import WholePicture
    from smartcam.frames._gige.description import Element

OPEN_TIMEOUT: Final = 60.0
"""Seconds for opening a camera; reading its description takes most of the time."""

RESEND_CAPABILITY: Final = 0x4
"""Bit of the register CAPABILITIES: the camera can send packets again."""

MAX_REMARK_LENGTH: Final = 1000
"""Largest number of characters of a frame's remark about unreadable chunk data."""

CAPABILITIES: Final = 0x0934
URL_SIZE: Final = 512
HEARTBEAT_TIMEOUTS: Final = (0.5, 60.0)
"""Least and largest heartbeat timeout, seconds; a camera's timeout beyond them is not believed."""


class GigESession:
    """A camera that is controlled until :meth:`close`.

    Args:
        control: control channel to the camera, closed with the session.
        label: name of the camera until its own name is known.
    """

    def __init__(self, control: ControlChannel, label: str) -> None:
        self.control = control
        self.label = label
        self.loss_error: FrameSourceError | None = None
        self.on_lost: Callable[[FrameSourceError], None] = lambda _: None
        self.ticks_per_second = 0
        self.can_resend = False
        self.has_streamed = False
        """Whether the camera has streamed before."""
        self.watches_exposures = False
        """Whether events about triggers are switched on."""
        self.event_ids_match = False
        """Whether an event has named the block of a received picture."""
        self.events = EventChannel(self)
        self._features: GenicamFeatures | None = None
        self._chunks: MessageFeatures | None = None
        self._can_latch, self._latched_ticks = True, cast("int | None", None)
        self._has_control = False
        self._heartbeat_task: asyncio.Task[None] | None = None

    @classmethod
    async def open(cls, host: str, port: int, label: str) -> GigESession:
        """Take control of a camera and read its description.

        Raises:
            FrameSourceError: the camera does not answer, another application controls it, or its
                description cannot be read.
        """
        control = await ControlChannel.connect(host, port, label)
        session = cls(control, label)
        try:
            async with asyncio.timeout(OPEN_TIMEOUT):
                await session._set_up()
        except TimeoutError as exc:
            await session.close()
            if isinstance(exc, FrameSourceError):
                raise
            raise FrameTimeoutError(
                f"{label}: not opened within {OPEN_TIMEOUT:g} s", source=label
            ) from exc
        except BaseException:
            await session.close()
            raise
        return session

    @property
    def features(self) -> GenicamFeatures:
        """Features of the camera that can be read and set."""
        if self._features is None:
            raise FrameSourceError(f"{self.label}: it is not open", source=self.label)
        return self._features

    def read_chunks(self, picture: WholePicture) -> tuple[Mapping[str, FeatureValue], str]:
        """Return the chunk values of a picture, and problems in reading them."""
        if picture.payload is None:
            return {}, ""
        try:
            if self._chunks is None:
                self._chunks = MessageFeatures(self.features, "ChunkID")
            values, problems = self._chunks.read(cut_chunks(picture.payload))
        except MessageError as exc:
            return {}, str(exc)
        return values, "; ".join(problems)[:MAX_REMARK_LENGTH]

    async def close(self) -> None:
        """Give up control of the camera. Idempotent.

        Cancellation: the socket is closed nevertheless; control ends after the camera's heartbeat
        timeout.
        """
        heartbeat_task, self._heartbeat_task = self._heartbeat_task, None
        has_control, self._has_control = self._has_control, False
        try:
            await self.events.close()
            if heartbeat_task is not None:
                heartbeat_task.cancel()
                await asyncio.wait([heartbeat_task])
            if has_control and self.loss_error is None:
                with contextlib.suppress(FrameSourceError):
                    await self.control.write_register(Register.CONTROL_PRIVILEGE, 0)
        finally:
            self.control.close()

    async def _set_up(self) -> None:
        names = await self.control.read(Register.MANUFACTURER_NAME, 176)
        model, serial, user = text(names[32:64]), text(names[144:160]), text(names[160:176])
        self.label = user or " ".join(part for part in (model, serial) if part) or self.label
        self.control.source = self.label
        await self._take_control()
        timeout = await self.control.read_register(Register.HEARTBEAT_TIMEOUT) / 1e3
        timeout = min(max(timeout, HEARTBEAT_TIMEOUTS[0]), HEARTBEAT_TIMEOUTS[1])
        self._heartbeat_task = asyncio.create_task(
            heartbeat(self.control, timeout, self.label, self._on_lost),
            name=f"heartbeat of {self.label}",
        )
        self.ticks_per_second = await self._register_or_0(
            Register.TICK_FREQUENCY_HIGH
        ) << 32 | await self._register_or_0(Register.TICK_FREQUENCY_LOW)
        self.can_resend = bool(await self._register_or_0(CAPABILITIES) & RESEND_CAPABILITY)
        self._features = GenicamFeatures(
            await read_description(self.control, self.label), self.control, self.label
        )

    async def read_clock(self) -> int | None:
        """Return the reading of the camera's clock, ticks; None: the clock cannot be read.

        A clock that stands still counts as unreadable: some cameras do not latch their clock.

        Raises:
            FrameSourceError: the camera does not answer.
        """
        if not self.ticks_per_second or not self._can_latch:
            return None
        try:
            await self.control.write_register(Register.TIMESTAMP_CONTROL, LATCH)
            high = await self.control.read_register(Register.LATCHED_TIMESTAMP_HIGH)
            low = await self.control.read_register(Register.LATCHED_TIMESTAMP_LOW)
        except RequestRefusedError:
            self._can_latch = False
            return None
        previous, self._latched_ticks = self._latched_ticks, high << 32 | low
        if previous is None:
            return await self.read_clock()
        return self._latched_ticks if self._latched_ticks > previous else None

    async def _register_or_0(self, address: int) -> int:
        """Return an optional register, 0 if the camera does not have it."""
        try:
            return await self.control.read_register(address)
        except RequestRefusedError:
            return 0

    def _on_lost(self, error: FrameSourceError) -> None:
        self.loss_error = error
        self.on_lost(error)
        self.events.end_watchers(error)

    async def _take_control(self) -> None:
        try:
            await self.control.write_register(Register.CONTROL_PRIVILEGE, CONTROL)
        except FrameSourceError as exc:
            if not await self._is_controlled_elsewhere(exc):
                raise
            other = await self._register_or_0(Register.PRIMARY_APPLICATION_ADDRESS)
            other_address = ".".join(str(part) for part in other.to_bytes(4, "big"))
            raise FrameSourceError(
                f"{self.label} is controlled by another application"
                f"{f' at {other_address}' if other else ''}: it has to give the camera back first",
                source=self.label,
            ) from exc
        self._has_control = True

    async def _is_controlled_elsewhere(self, error: FrameSourceError) -> bool:
        """Return True if taking control failed because another application has control.

        A camera should refuse with ACCESS_DENIED; the fake camera of Aravis does not answer at all.
        """
        if isinstance(error, RequestRefusedError):
            return error.status == GvcpStatus.ACCESS_DENIED
        if isinstance(error, FrameTimeoutError):
            privilege = await self.control.read_register(Register.CONTROL_PRIVILEGE)
            return bool(privilege & (CONTROL | EXCLUSIVE))
        return False


async def read_description(control: ControlChannel, label: str) -> dict[str, Element]:
    """Read a camera's description; try the second URL if the first fails.

    Raises:
        FrameSourceError: no URL leads to a description.
    """
    failures = []
    for address in (Register.FIRST_URL, Register.FIRST_URL + URL_SIZE):
        url = text(await control.read(address, URL_SIZE))
        try:
            location = locate(url)
            data = await control.read(location.address, location.length)
            return await _in_thread(functools.partial(_nodes, data), label)
        except (MessageError, RequestRefusedError) as exc:
            failures.append(str(exc))
    raise FrameSourceError(
        f"{label}: its description cannot be read: {'; '.join(failures)}", source=label
    )


def _nodes(data: bytes) -> dict[str, Element]:
    return parse(unpack(data))


async def _in_thread(work: Callable[[], dict[str, Element]], label: str) -> dict[str, Element]:
    """Parse in a thread, since 2 MB of XML take a quarter of a second."""
    pool = ThreadPoolExecutor(1, thread_name_prefix=f"description of {label}")
    try:
        return await asyncio.get_running_loop().run_in_executor(pool, work)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
