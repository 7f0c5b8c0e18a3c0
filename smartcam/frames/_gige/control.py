"""Run the control channel of one camera: requests, answers, and the heartbeat.

One request is pending at a time. A request without an answer is sent again with the same id, so
that the camera recognizes it; answers that are late or have another id are dropped.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from typing import TYPE_CHECKING, Final, cast

from smartcam.exceptions import FrameSourceError, FrameTimeoutError, MessageError
from smartcam.frames._gige.gvcp import (
    CONTROL,
    EXCLUSIVE,
    MAX_BYTES_PER_REQUEST,
    Ack,
    GvcpCommand,
    GvcpStatus,
    Register,
    decode_ack,
    encode,
    encode_resend,
    readmem_payload,
    readreg_payload,
    status_text,
    writemem_payload,
    writereg_payload,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.frames._gige.assembler import Resend

ANSWER_TIMEOUT: Final = 0.3
"""Seconds for an answer: by the standard, a camera answers or says "pending" within 200 ms."""

MAX_ATTEMPTS: Final = 3

IP_MTU: Final = 14
"""Socket option for the MTU of the path of a connected socket, from linux/in.h."""

MAX_PENDING_TIME: Final = 30.0
"""Longest time, seconds, for which a camera may delay the answer to a request."""


class ControlChannel(asyncio.DatagramProtocol):
    """Requests to one camera.

    Args:
        source: the camera's name, for errors.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        self._transport: asyncio.DatagramTransport | None = None
        self._lock = asyncio.Lock()
        self._id = 0
        self._expected_id = 0  # id of the pending request; 0: none
        self._answers: asyncio.Queue[Ack | OSError] = asyncio.Queue(maxsize=16)
        self.dropped = 0
        """Number of datagrams that answered no request."""

    @classmethod
    async def connect(cls, host: str, port: int, source: str) -> ControlChannel:
        """Return a channel to a camera, without sending.

        Raises:
            FrameSourceError: the host's name is unknown, or there is no route.
        """
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(5):
                _, channel = await loop.create_datagram_endpoint(
                    lambda: cls(source), remote_addr=(host, port), family=socket.AF_INET
                )
        except OSError as exc:  # a TimeoutError is an OSError
            raise FrameSourceError(
                f"{source}: {host}:{port} cannot be reached: {exc or 'no name server answers'}",
                source=source,
            ) from exc
        return channel

    @property
    def local_address(self) -> str:
        """Address of this host, as the camera reaches it."""
        return str(self._socket_address("sockname")[0])

    @property
    def camera_address(self) -> str:
        """Address of the camera."""
        return str(self._socket_address("peername")[0])

    @property
    def path_mtu(self) -> int:
        """Size of the largest IP packet on the path, bytes; 1500 if the system does not know it."""
        if self._transport is None or sys.platform != "linux":
            return 1500
        sock = self._transport.get_extra_info("socket")
        return int(sock.getsockopt(socket.IPPROTO_IP, IP_MTU))

    def close(self) -> None:
        """Close the socket. Idempotent."""
        if self._transport is not None:
            self._transport.abort()
            self._transport = None

    async def read_register(self, address: int) -> int:
        """Return the value of a register.

        Raises:
            FrameSourceError: the camera refuses, or does not answer.
        """
        payload = await self.request(
            GvcpCommand.READREG, readreg_payload(address), 4, f"{address:#06x}"
        )
        return int.from_bytes(payload[:4], "big")

    async def write_register(self, address: int, value: int) -> None:
        """Write a register; errors as in :meth:`read_register`."""
        subject = f"{address:#06x} = {value:#x}"
        await self.request(GvcpCommand.WRITEREG, writereg_payload((address, value)), 0, subject)

    async def read(self, address: int, length: int) -> bytes:
        """Return bytes of the camera's memory; errors as in :meth:`read_register`."""
        if length == 4 and address % 4 == 0:
            return (await self.read_register(address)).to_bytes(4, "big")
        begin = address & ~3
        end = (address + length + 3) & ~3
        parts = []
        for offset in range(begin, end, MAX_BYTES_PER_REQUEST):
            count = min(MAX_BYTES_PER_REQUEST, end - offset)
            payload = await self.request(
                GvcpCommand.READMEM,
                readmem_payload(offset, count),
                4 + count,
                f"{offset:#06x}, {count}",
            )
            parts.append(payload[4 : 4 + count])
        return b"".join(parts)[address - begin :][:length]

    async def write(self, address: int, data: bytes) -> None:
        """Write into the camera's memory; errors as in :meth:`read_register`."""
        if len(data) == 4 and address % 4 == 0:
            await self.write_register(address, int.from_bytes(data, "big"))
            return
        begin = address & ~3
        end = (address + len(data) + 3) & ~3
        if end - begin != len(data):  # only whole words can be written
            words = await self.read(begin, end - begin)
            data = words[: address - begin] + data + words[address - begin + len(data) :]
        for offset in range(begin, end, MAX_BYTES_PER_REQUEST):
            chunk = data[offset - begin :][:MAX_BYTES_PER_REQUEST]
            payload, subject = writemem_payload(offset, chunk), f"{offset:#06x}, {len(chunk)}"
            await self.request(GvcpCommand.WRITEMEM, payload, 0, subject)

    def request_resend(self, packets: Resend) -> None:
        """Request packets again; the camera sends the packets, but no other answer."""
        if self._transport is not None and not self._transport.is_closing():
            data = encode_resend(
                self._next_id(),
                packets.block,
                packets.first,
                packets.last,
                extended=packets.extended,
            )
            self._transport.sendto(data)

    async def request(
        self, command: GvcpCommand, payload: bytes, min_size: int, subject: str
    ) -> bytes:
        """Send a request and return the payload of the answer.

        Args:
            command: command of the request.
            payload: payload of the request.
            min_size: smallest number of bytes of the answer's payload.
            subject: subject of the request, for errors.

        Raises:
            FrameSourceError: the camera refuses, its answer is too short, or the channel is closed.
            FrameTimeoutError: the camera does not answer.

        Cancellation: safe; the camera may have carried out the request, its answer is dropped.
        """
        async with self._lock:
            request_id = self._next_id()
            datagram = encode(command, request_id, payload)
            try:
                self._expected_id = request_id
                for _ in range(MAX_ATTEMPTS):
                    ack = await self._send_once(datagram, command, subject)
                    if ack is not None:
                        return self._check_payload(ack, command, min_size, subject)
            finally:
                self._expected_id = 0
                self._drop_answers()
        raise FrameTimeoutError(
            f"{self.source}: no answer to {command.name} {subject} in "
            f"{MAX_ATTEMPTS} x {ANSWER_TIMEOUT:g} s",
            source=self.source,
        )

    async def _send_once(self, datagram: bytes, command: GvcpCommand, subject: str) -> Ack | None:
        """Send a request; return its answer, or None if none comes in time."""
        if self._transport is None or self._transport.is_closing():
            raise FrameSourceError(f"{self.source}: it is closed", source=self.source)
        loop = asyncio.get_running_loop()
        self._transport.sendto(datagram)
        started_at = loop.time()
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT) as limit:
                while True:
                    ack = await self._answers.get()
                    if isinstance(ack, OSError):
                        raise FrameSourceError(
                            f"{self.source}: {command.name} {subject}: nothing listens there that "
                            f"speaks GVCP: {ack}",
                            source=self.source,
                        ) from ack
                    if ack.command != GvcpCommand.PENDING_ACK:
                        return ack
                    wait = int.from_bytes(ack.payload[2:4], "big") / 1e3 + ANSWER_TIMEOUT
                    limit.reschedule(min(loop.time() + wait, started_at + MAX_PENDING_TIME))
        except TimeoutError:
            return None

    def _check_payload(self, ack: Ack, command: GvcpCommand, min_size: int, subject: str) -> bytes:
        if ack.status != GvcpStatus.SUCCESS:
            raise RequestRefusedError(
                f"{self.source}: {command.name} {subject}: the camera answers "
                f"{status_text(ack.status)}",
                source=self.source,
                status=ack.status,
            )
        if ack.command != command + 1 or len(ack.payload) < min_size:
            raise FrameSourceError(
                f"{self.source}: {command.name} {subject}: expected an answer {command + 1:#06x} "
                f"of {min_size} bytes, got {ack.command:#06x} of {len(ack.payload)}",
                source=self.source,
            )
        return ack.payload

    def _next_id(self) -> int:
        self._id = self._id % 0xFFFF + 1
        return self._id

    def _drop_answers(self) -> None:
        while not self._answers.empty():
            self._answers.get_nowait()

    def _socket_address(self, name: str) -> tuple[str, int]:
        if self._transport is None:
            raise FrameSourceError(f"{self.source}: it is closed", source=self.source)
        return cast("tuple[str, int]", self._transport.get_extra_info(name))

    def _put_answer(self, answer: Ack | OSError) -> None:
        if self._expected_id and not self._answers.full():
            self._answers.put_nowait(answer)
        else:
            self.dropped += 1

    # asyncio calls these

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport."""
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: object) -> None:
        """Accept a datagram if it answers the pending request."""
        try:
            ack = decode_ack(data)
        except MessageError:
            self.dropped += 1
            return
        if ack.request_id == self._expected_id:
            self._put_answer(ack)
        else:
            self.dropped += 1

    def error_received(self, exc: Exception) -> None:
        """Fail the pending request: no process listens at the address."""
        if isinstance(exc, OSError):
            self._put_answer(exc)


class RequestRefusedError(FrameSourceError):
    """The camera answered with an error.

    Attributes:
        status: member of :class:`~smartcam.frames._gige.gvcp.GvcpStatus`.
    """

    def __init__(
        self, message: str, *, source: str = "", available: tuple[str, ...] = (), status: int = 0
    ) -> None:
        super().__init__(message, source=source, available=available)
        self.status = status


async def heartbeat(
    control: ControlChannel,
    timeout: float,
    source: str,
    on_lost: Callable[[FrameSourceError], None],
) -> None:
    """Keep control of a camera until control is lost, then call ``on_lost``.

    Args:
        control: control channel of the camera.
        timeout: seconds without a request after which the camera gives up control.
        source: name of the camera, for errors.
        on_lost: function that is called once, at the end, with the error.
    """
    loop = asyncio.get_running_loop()
    last_answer_at = loop.time()
    while True:
        await asyncio.sleep(timeout / 3)
        try:
            privilege = await control.read_register(Register.CONTROL_PRIVILEGE)
        except FrameSourceError as exc:
            if loop.time() - last_answer_at >= timeout:
                error = FrameSourceError(
                    f"{source}: no answer for {loop.time() - last_answer_at:.1f} s: {exc}",
                    source=source,
                )
                error.__cause__ = exc
                on_lost(error)
                return
            continue
        if not privilege & (CONTROL | EXCLUSIVE):
            on_lost(
                FrameSourceError(
                    f"{source}: control was lost: the camera restarted, or got no heartbeat for "
                    f"{timeout:g} s",
                    source=source,
                )
            )
            return
        last_answer_at = loop.time()
