"""One camera under our control: its description read, its features set, its heartbeat kept."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import FrameSourceError, FrameTimeoutError, MessageError
from smartcam.frames._gige._control import ControlChannel, RequestRefusedError, heartbeat
from smartcam.frames._gige._description import locate, parse, unpack
from smartcam.frames._gige._features import GenicamFeatures
from smartcam.frames._gige._gvcp import CONTROL, EXCLUSIVE, GvcpStatus, Register, text

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._gige._description import Element

OPENING: Final = 60.0
"""Seconds until a camera is opened; most of it is its description, 512 bytes at a time."""

RESEND_CAPABILITY: Final = 0x4
"""In the register of what the control channel can do, 0x0934."""

CAPABILITIES: Final = 0x0934
URL_SIZE: Final = 512
HEARTBEATS: Final = (0.5, 60.0)
"""Seconds between which a camera's own heartbeat timeout is taken as it is."""


class GigESession:
    """A camera that is ours until :meth:`close`.

    Args:
        control: its control channel, which is closed with it.
        label: its name until it says one.
    """

    def __init__(self, control: ControlChannel, label: str) -> None:
        self.control = control
        self.label = label
        self.lost: FrameSourceError | None = None
        self.on_lost: Callable[[FrameSourceError], None] = lambda _: None
        self.ticks_per_second = 0
        self.can_resend = False
        self._features: GenicamFeatures | None = None
        self._ours = False
        self._heart: asyncio.Task[None] | None = None

    @classmethod
    async def open(cls, host: str, port: int, label: str) -> GigESession:
        """Take control of a camera and read its description.

        Raises:
            FrameSourceError: it is not there, another application has it, or its description
                cannot be read.
        """
        control = await ControlChannel.connect(host, port, label)
        session = cls(control, label)
        try:
            async with asyncio.timeout(OPENING):
                await session._begin()
        except TimeoutError as exc:
            await session.close()
            if isinstance(exc, FrameSourceError):
                raise
            raise FrameTimeoutError(
                f"{label}: it was not opened in {OPENING:g} s", source=label
            ) from exc
        except BaseException:
            await session.close()
            raise
        return session

    @property
    def features(self) -> GenicamFeatures:
        """What can be asked and set."""
        if self._features is None:
            raise FrameSourceError(f"{self.label}: it is not open", source=self.label)
        return self._features

    async def close(self) -> None:
        """Give the camera back. Idempotent.

        Cancellation: the socket is closed all the same; the camera frees itself after its
        heartbeat's timeout.
        """
        heart, self._heart = self._heart, None
        ours, self._ours = self._ours, False
        try:
            if heart is not None:
                heart.cancel()
                await asyncio.wait([heart])
            if ours and self.lost is None:
                with contextlib.suppress(FrameSourceError):
                    await self.control.write_register(Register.CONTROL_PRIVILEGE, 0)
        finally:
            self.control.close()

    async def _begin(self) -> None:
        names = await self.control.read(Register.MANUFACTURER_NAME, 176)
        model, serial, user = text(names[32:64]), text(names[144:160]), text(names[160:176])
        self.label = user or " ".join(part for part in (model, serial) if part) or self.label
        self.control.source = self.label
        await self._take_control()
        timeout = await self.control.read_register(Register.HEARTBEAT_TIMEOUT) / 1e3
        timeout = min(max(timeout, HEARTBEATS[0]), HEARTBEATS[1])
        self._heart = asyncio.create_task(
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

    async def _register_or_0(self, address: int) -> int:
        """Return a register that a camera need not have."""
        try:
            return await self.control.read_register(address)
        except RequestRefusedError:
            return 0

    def _on_lost(self, error: FrameSourceError) -> None:
        self.lost = error
        self.on_lost(error)

    async def _take_control(self) -> None:
        try:
            await self.control.write_register(Register.CONTROL_PRIVILEGE, CONTROL)
        except FrameSourceError as exc:
            if not await self._is_taken(exc):
                raise
            other = await self._register_or_0(Register.PRIMARY_APPLICATION_ADDRESS)
            where = ".".join(str(part) for part in other.to_bytes(4, "big"))
            raise FrameSourceError(
                f"{self.label} is controlled by another application"
                f"{f' at {where}' if other else ''}: it has to give the camera back first",
                source=self.label,
            ) from exc
        self._ours = True

    async def _is_taken(self, error: FrameSourceError) -> bool:
        """Return whether taking control failed since somebody else has it.

        A camera is to say so; aravis' fake one does not answer at all.
        """
        if isinstance(error, RequestRefusedError):
            return error.status == GvcpStatus.ACCESS_DENIED
        if isinstance(error, FrameTimeoutError):
            privilege = await self.control.read_register(Register.CONTROL_PRIVILEGE)
            return bool(privilege & (CONTROL | EXCLUSIVE))
        return False


async def read_description(control: ControlChannel, label: str) -> dict[str, Element]:
    """Read a camera's description; the second URL is tried where the first one leads nowhere.

    Raises:
        FrameSourceError: neither leads to one.
    """
    tried = []
    for address in (Register.FIRST_URL, Register.FIRST_URL + URL_SIZE):
        url = text(await control.read(address, URL_SIZE))
        try:
            lies = locate(url)
            data = await control.read(lies.address, lies.length)
            return await _in_thread(functools.partial(_nodes, data), label)
        except (MessageError, RequestRefusedError) as exc:
            tried.append(str(exc))
    raise FrameSourceError(
        f"{label}: its description cannot be read: {'; '.join(tried)}", source=label
    )


def _nodes(data: bytes) -> dict[str, Element]:
    return parse(unpack(data))


async def _in_thread(work: Callable[[], dict[str, Element]], label: str) -> dict[str, Element]:
    """Do work beside the loop: 2 MB of XML take a quarter of a second."""
    pool = ThreadPoolExecutor(1, thread_name_prefix=f"description of {label}")
    try:
        return await asyncio.get_running_loop().run_in_executor(pool, work)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
