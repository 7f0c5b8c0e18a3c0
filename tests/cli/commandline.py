"""A bench for the command line: commands, emulated cameras, and cameras that misbehave.

Bytes of the wire stand here as constants, worked out by hand from the published layouts.
"""

from __future__ import annotations

import contextlib
import io
import socket
import struct
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Self
from unittest import mock

import smartcam._cli
from tests.processes import PATIENCE, Outcome, Process

CONNECT = bytes.fromhex("50535642 00000000 01000000")
CONNECTED = bytes.fromhex("50535642 04000000 01000000 01000000")
DISCONNECT = bytes.fromhex("50535642 00000000 02000000")
QUERY = bytes.fromhex("50535642 00000000 30000000")
ACTIVE_21 = bytes.fromhex("50535642 04000000 30000000 15000000")
SWITCH_5 = bytes.fromhex("50535642 04000000 31000000 05000000")
SWITCHED_5 = bytes.fromhex("50535642 08000000 31000000 00000000 05000000")
TRIGGER = bytes.fromhex("50535642 00000000 40000000")
START = bytes.fromhex("50535642 00000000 41000000")
STOPPED = bytes.fromhex("50535642 08000000 12000000 00000000 00000000")
BUSY = bytes.fromhex("50535642 08000000 12000000 10000000 00000000")
INSPECTING = bytes.fromhex("50535642 08000000 12000000 80000000 00000000")
WAITING = bytes.fromhex("50535642 08000000 12000000 80020000 00000000")
HELLO_WORLD = bytes.fromhex(
    "50535642 18000000 20000000 15000000 48656c6c6f20576f726c64 000000000000000000"
)
BOMB = bytes.fromhex("50535642 ffffffff 20000000")
"""A header that announces 4 GiB."""

DIE = b"die"
"""As an answer: reset the connection."""

SESSION: Mapping[bytes, bytes] = {CONNECT: CONNECTED + WAITING, QUERY: ACTIVE_21}
"""Frames that a camera in application 21 sends until it is triggered."""

SCENARIO = """\
applications:
  - {id: 2, layout: "n: int32 @sequence", generator: sequence, load_time: 0, processing_time: 0}
  - {id: 4, layout: "text: string[8]", constant: {text: "a\\nb\\e[m"},
     load_time: 0, processing_time: 0}
  - {id: 5, layout: "n: int32", generator: sequence, rate: 100, load_time: 0,
     processing_time: 0.001}
  - {id: 6, layout: "n: int32", constant: {n: 1}, load_time: 0, processing_time: 60}
  - {id: 8, layout: "(name: string[8], x: real32 mm)*", load_time: 0, processing_time: 0,
     constant: [{name: "bolt", x: 0.112}, {name: "nut", x: 0.187}]}
  - id: 7
    layout: "(feature_id: string[50], quality: real32, photo_index: int32,
      x: real32, y: real32, theta: real32)*"
    generator: tangram
    load_time: 0
    processing_time: 0
  - {id: 11, layout: "a: string[50], b: string[50]", constant: {a: "one", b: ""},
     load_time: 0, processing_time: 0}
  - {id: 13, layout: "order: int32", input: "order: int32", generator: input,
     load_time: 0, processing_time: 0}
  - {id: 21, layout: "text: string[20]", constant: {text: "Hello World"},
     load_time: 0, processing_time: 0}
"""


def thesis(frame: bytes) -> bytes:
    """Return a handbook frame as the thesis writes it: other magic, the length counts the id."""
    length = int.from_bytes(frame[4:8], "little") + 4
    return bytes.fromhex("42565350") + length.to_bytes(4, "little") + frame[8:]


# ---------------------------------------------------------------------- commands


def run(
    *args: str,
    stdin: bytes = b"",
    program: str = "smartcam",
    main: Callable[[], None] | None = None,
) -> Outcome:
    """Run a command in this process."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    code = 0
    with (
        mock.patch.object(sys, "argv", [program, *args]),
        mock.patch.object(sys, "stdin", io.TextIOWrapper(io.BytesIO(stdin), encoding="utf-8")),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            (main or smartcam._cli.main)()
        except SystemExit as exc:
            code = exc.code if isinstance(exc.code, int) else 0
    out.seek(0)
    err.seek(0)
    return Outcome(code, out.read(), err.read())


@contextlib.contextmanager
def each(*case: object) -> Iterator[None]:
    """Name the case of a loop in what goes wrong with it."""
    try:
        yield
    except BaseException as exc:
        exc.add_note(f"in the case {case}")
        raise


def run_as_far_as(text: str, *args: str) -> Outcome:
    """Run a command whose time-out ends it, but not before it has said ``text``.

    A slow machine gets a longer one.
    """
    for seconds in ("0.3", "3", "60"):
        outcome = run(*args, "--timeout", seconds)
        if text in outcome.out + outcome.err:
            break
    return outcome


def run_emulator(*args: str) -> Outcome:
    """Run ``smartcam-emulator`` in this process, where it is to end by itself."""
    return run(*args, program="smartcam-emulator", main=smartcam._cli.emulator_main)


# ---------------------------------------------------------------------- cameras


@contextlib.contextmanager
def emulators(folder: Path, *options: tuple[str, ...]) -> Iterator[list[str]]:
    """Run an emulator for each tuple of options; gives their URLs."""
    scenario = folder / "quick.yaml"
    scenario.write_text(SCENARIO, encoding="utf-8")
    with contextlib.ExitStack() as stack:
        started = [
            stack.enter_context(Process("smartcam-emulator", str(scenario), *each))
            for each in options
        ]
        yield [process.read_until(b"\n").strip() for process in started]
        for process in started:
            process.send_signal(15)
        for process in started:
            process.wait().done()


class Peer:
    """Something at the other end that does exactly what a table says, on loopback TCP."""

    def __init__(self, answers: Mapping[bytes, bytes] | None = None, greeting: bytes = b"") -> None:
        # what it sends for a whole frame; nothing for a frame that is not in it
        self._answers = answers or {}
        self._greeting = greeting  # what it sends as soon as a connection is there
        self._received = b""
        self._more = threading.Condition()
        self._closing = False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._thread = threading.Thread(target=self._serve, name="peer")
        self._thread.start()

    @property
    def host_and_port(self) -> str:
        """The address on which the process listens."""
        return f"127.0.0.1:{self._listener.getsockname()[1]}"

    @property
    def url(self) -> str:
        """Its address, the dialect pinned."""
        return f"bvs://{self.host_and_port}?dialect=handbook"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._closing = True
        # wakes the thread where it waits for a connection
        socket.create_connection(self._listener.getsockname(), PATIENCE).close()
        self._thread.join(PATIENCE)
        self._listener.close()
        assert not self._thread.is_alive()

    def wait_received(self, data: bytes) -> None:
        """Wait until these bytes have come."""
        with self._more:
            assert self._more.wait_for(lambda: data in self._received, PATIENCE)

    def wait_last(self, data: bytes) -> None:
        """Wait until the last bytes that came are these."""
        with self._more:
            assert self._more.wait_for(lambda: self._received.endswith(data), PATIENCE)

    def _serve(self) -> None:
        while not self._closing:
            connection, _ = self._listener.accept()
            connection.settimeout(PATIENCE)
            with connection, contextlib.suppress(OSError):
                self._converse(connection)

    def _converse(self, connection: socket.socket) -> None:
        connection.sendall(self._greeting)
        buffer = b""
        while data := connection.recv(4096):
            with self._more:
                self._received += data
                self._more.notify_all()
            buffer += data
            while len(buffer) >= 12:
                size = 12 + int.from_bytes(buffer[4:8], "little")
                frame, buffer = buffer[:size], buffer[size:]
                answer = self._answers.get(frame, b"")
                if answer is DIE:
                    linger = struct.pack("ii", 1, 0)
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
                    return
                connection.sendall(answer)


@contextlib.contextmanager
def closed_port() -> Iterator[str]:
    """Give host and port of an address where nothing listens."""
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        yield f"127.0.0.1:{reserved.getsockname()[1]}"
