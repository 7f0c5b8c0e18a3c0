"""Native mode as a client's machine hears it, written down by hand, and a machine to hear it."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from smartcam.protocols import Role, State, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import Event
from tests.protocols.inside import NATIVE, InSightDialect, InSightMachine

if TYPE_CHECKING:
    from smartcam.protocols import Frame

GREETING = b"Welcome to In-Sight(tm)  8502P Session 0\r\nUser: "
LOGIN = GREETING + b"Password: User Logged In\r\n"
BITMAP = b"BM" + struct.pack("<I", 50) + bytes(range(44))
DIGITS = BITMAP.hex().upper().encode()
IMAGE_LINES = DIGITS[:80] + b"\r\n" + DIGITS[80:] + b"\r\n" + b"BD5E\r\n"
"""A file of 50 bytes in the camera's lines; the checksum was worked out by :func:`crc`."""


def crc(digits: bytes) -> bytes:
    """Return the checksum by the polynomial's definition, bit by bit."""
    register = 0
    for byte in digits:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1) ^ (0x1021 if register & 0x8000 else 0)
            register &= 0xFFFF
    return f"{register:04X}".encode()


def with_cells(*cells: str) -> InSightDialect:
    """Return the dialect with cells to read."""
    return NATIVE.with_parameters({"cells": ",".join(cells)})


class Talk:
    """A machine, what it wrote and what it told.

    Args:
        dialect: of the machine.
        max_length: of the machine.
    """

    def __init__(self, dialect: InSightDialect = NATIVE, max_length: int = 1000) -> None:
        self.traced: list[tuple[m.Sender, Frame | Exception]] = []
        self.machine = InSightMachine(
            dialect,
            Role.CLIENT,
            Transport.TCP,
            max_length=max_length,
            trace=lambda sender, frame: self.traced.append((sender, frame)),
        )

    def logged_in(self) -> Talk:
        """Log in, and forget what was said for that."""
        self.machine.send(m.Connect())
        self.hear(LOGIN)
        self.told()
        self.written()
        assert self.machine.state is State.CONNECTED
        return self

    def send(self, message: m.Message) -> bytes:
        """Send, and return what is written for it."""
        self.machine.send(message)
        return self.written()

    def hear(self, data: bytes) -> bytes:
        """Take bytes, and return what is written at them."""
        self.machine.receive_data(data)
        return self.written()

    def written(self) -> bytes:
        return b"".join(self.machine.data_to_send())

    def told(self) -> list[Event]:
        return self.machine.events()
