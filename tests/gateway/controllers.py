# ruff: noqa: N802, N803 - the names are those of the controllers
"""Stubs of robots' controllers: what the examples call, as each make's manual describes it.

They have sockets of their own, and share nothing with the gateway. Each runs its example in a
thread; :class:`DoneError` ends the program, which goes on for ever otherwise.
"""

from __future__ import annotations

import math
import re
import socket
import struct
import time
from collections import deque
from typing import Any
from xml.etree import ElementTree

from tests import ROOT
from tests.gateway.languages import from_karel, from_krl, from_scl, from_urscript

ROBOTS = ROOT / "examples" / "robots"


class DoneError(Exception):
    """The controller has done what the test waits for."""


class Wire:
    """A socket as a controller has it: what came is kept until it is read."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.sock: socket.socket | None = None
        self.came = b""
        self.sent: list[bytes] = []

    def open(self) -> bool:
        self.close()
        self.came = b""
        try:
            self.sock = socket.create_connection(("127.0.0.1", self.port), 2.0)
        except OSError:
            return False
        return True

    def close(self) -> None:
        if self.sock is not None:
            self.sock.close()
        self.sock = None

    def send(self, data: bytes) -> bool:
        self.sent.append(data)
        if self.sock is None:
            return False
        try:
            self.sock.sendall(data)
        except OSError:
            return False
        return True

    def receive(self, seconds: float) -> bool:
        """Receive bytes for some seconds; return whether there were any."""
        if self.sock is None:
            return False
        self.sock.settimeout(max(seconds, 1e-3))
        try:
            data = self.sock.recv(4096)
        except OSError:
            return False
        self.came += data
        return bool(data)


class Frame:
    """A FRAME of KRL: one that is only declared has no values."""

    def __init__(self, other: Frame | None = None) -> None:
        for name in "XYZABC":
            setattr(self, name, getattr(other, name, None))

    @classmethod
    def null(cls) -> Frame:
        """Return $NULLFRAME."""
        frame = cls()
        for name in "XYZABC":
            setattr(frame, name, 0.0)
        return frame

    def numbers(self) -> list[float]:
        return [getattr(self, name) for name in "XYZABC"]


class Controller:
    """A controller: its socket, and what it has done.

    Args:
        port: of the gateway.
        picks: parts after which it is done.
        patience: how long it waits for an answer, as a part of what its example says.
        attempts: answers with an error after which it is done.
    """

    def __init__(self, port: int, picks: int, *, patience: float = 1.0, attempts: int = 3) -> None:
        self.wire = Wire(port)
        self.picks, self.patience, self.attempts = picks, patience, attempts
        self.poses: list[list[float]] = []
        self.errors: list[float] = []

    def run(self) -> None:
        """Run the example until it is done."""
        try:
            self._run()
        except DoneError:
            self.wire.close()

    def _run(self) -> None:
        raise NotImplementedError

    def _execute(self, text: str, name: str, names: dict[str, Any]) -> None:
        exec(compile(text, name, "exec"), names)  # noqa: S102 - our own example

    def failed(self, code: float) -> None:
        """Count an answer that is none, or an error."""
        self.errors.append(code)
        if len(self.errors) >= self.attempts:
            raise DoneError

    def _names(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in dir(self) if name[:2] != "__"}


def real(value: float) -> float:
    """Return a number as a REAL of 32 bits has it."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


class UrController(Controller):
    """Universal Robots: Script Manual, module interfaces.

    ``socket_read_ascii_float`` reads 30 numbers at most, in parentheses with commas between them,
    and gives how many it read, and then each; after a timeout 0 and NaN.
    """

    example = "smartcam_ur.script"

    def _run(self) -> None:
        names = self._names()
        names["p"] = type("P", (), {"__getitem__": lambda self, numbers: list(numbers)})()
        names["sleep"] = lambda seconds: time.sleep(min(seconds, 0.01))
        self._execute(from_urscript((ROBOTS / self.example).read_text()), self.example, names)
        names["smartcam_pick"]()

    def socket_open(self, _address: str, _port: int, _name: str) -> bool:
        return self.wire.open()

    def socket_close(self, _name: str) -> None:
        self.wire.close()

    def socket_send_line(self, text: str, _name: str) -> bool:
        return self.wire.send(text.encode() + b"\n")

    def socket_read_ascii_float(self, number: int, _name: str, timeout: float) -> list[float]:
        assert 1 <= number <= 30
        end = time.monotonic() + timeout * self.patience
        while b")" not in self.wire.came:
            if not self.wire.receive(end - time.monotonic()):
                self.failed(99)
                return [0.0, *[math.nan] * number]
        text, _, self.wire.came = self.wire.came.partition(b")")
        numbers = [float(one) for one in text.partition(b"(")[2].split(b",")]
        numbers = numbers[:number]
        return [float(len(numbers)), *numbers, *[math.nan] * (number - len(numbers))]

    def textmsg(self, text: str, value: float) -> None:
        assert text == "smartcam: error "
        self.failed(value)

    def pose_trans(self, pose: list[float], by: list[float]) -> list[float]:
        return [*pose[:2], pose[2] + by[2], *pose[3:]]

    def movel(self, pose: list[float], _a: float, v: float) -> None:
        if v == 0.05:  # towards the part
            self.poses.append(pose)
            if len(self.poses) >= self.picks:
                raise DoneError

    def set_standard_digital_out(self, _number: int, _value: bool) -> None: ...


class KukaController(Controller):
    """KUKA with EthernetKRL: its manual, XML with FIFO buffers.

    The configuration file says which elements are kept: each has a queue of its own, from which
    the oldest is taken; one that overflows ends the connection. A channel is initialized before it
    is opened or cleared, and once. Values are read into variables that have one.
    """

    example = "smartcam.src"

    def __init__(self, port: int, picks: int, **more: Any) -> None:
        super().__init__(port, picks, **more)
        config = ElementTree.parse(ROBOTS / "smartcam.xml").getroot()  # noqa: S314 - our own
        self.limit = int(config.find("CONFIGURATION/INTERNAL/BUFFERING").get("Limit"))  # type: ignore[union-attr, arg-type]
        self.alive = int(config.find("CONFIGURATION/INTERNAL/ALIVE").get("Set_Flag"))  # type: ignore[union-attr, arg-type]
        self.elements = {one.get("Tag", ""): one for one in config.iterfind("RECEIVE/XML/ELEMENT")}
        (self.outgoing,) = [one.get("Tag", "") for one in config.iterfind("SEND/XML/ELEMENT")]
        self.queues: dict[str, deque[str]] = {}
        self.flags = [False] * 20
        self.values: dict[str, str] = {}
        self.deadline = math.inf
        self.initialized = False

    def _run(self) -> None:
        names = self._names()
        names |= {"Frame": Frame, "_FLAG": self.flags, "_OUT": [False] * 20, "_AXIS_ACT": None}
        names |= {"_TIMER": _Timers(self), "_TIMER_STOP": [True] * 20}
        names |= {"_TIMER_FLAG": _TimerFlags(self), "PTP": lambda _: None, "BAS": lambda *_: None}
        names["sleep"] = lambda seconds: time.sleep(min(seconds, 0.01))
        self._execute(from_krl((ROBOTS / self.example).read_text()), self.example, names)
        names["smartcam"]()

    def EKI_Init(self, name: str) -> int:
        assert (ROBOTS / f"{name}.xml").is_file()
        assert not self.initialized
        self.initialized = True
        self.queues = {tag: deque() for tag, one in self.elements.items() if one.get("Type")}
        return 0

    def EKI_Open(self, _name: str) -> int:
        assert self.initialized
        self.flags[self.alive] = self.wire.open()
        return 0

    def EKI_Close(self, _name: str) -> int:
        self.wire.close()
        self.flags[self.alive] = False
        self.failed(99)
        return 0

    def EKI_Clear(self, _name: str) -> int:
        assert self.initialized
        self.initialized = False
        self.wire.close()
        self.flags[self.alive] = False
        return 0

    def EKI_ClearBuffer(self, _name: str, tag: str) -> int:
        self._take(0.001)
        self.queues[tag].clear()
        return 0

    def EKI_SetString(self, _name: str, tag: str, text: str) -> int:
        assert tag == self.outgoing
        self.values[tag] = text
        return 0

    def EKI_Send(self, _name: str, root: str) -> int:
        outer, inner = self.outgoing.split("/")
        assert outer == root
        end = "\r\n" if len(self.wire.sent) % 2 else ""  # the manual does not say
        value = self.values[self.outgoing]
        text = f"<{outer}>{end}<{inner}>{value}</{inner}>{end}</{outer}>{end}"
        self.wire.send(text.encode())
        return 0

    def EKI_GetInt(self, _name: str, tag: str, _before: int) -> tuple[int, int]:
        value = int(self.queues[tag].popleft())
        if value > 1:
            self.failed(value)
        return 0, value

    def EKI_GetReal(self, _name: str, tag: str, before: float | None) -> tuple[int, float]:
        assert before is not None, "a variable without a value"
        return 0, real(float(self.queues[tag].popleft()))

    def wait_for(self, true: Any) -> None:
        while not true():
            self._take(0.01)

    def _take(self, seconds: float) -> None:
        """Take what came into the queues, element by element."""
        self.wire.receive(seconds)
        text, mark, rest = self.wire.came.partition(b"</Gateway>")
        if not mark:
            return
        self.wire.came = rest
        root = ElementTree.fromstring(text + mark)  # noqa: S314 - of the gateway
        for tag, one in self.elements.items():
            if not one.get("Type"):
                self.flags[int(one.get("Set_Flag", "0"))] = True
                continue
            path, _, attribute = tag.removeprefix("Gateway/").partition("/@")
            node = root.find(path)
            assert node is not None, tag
            self.queues[tag].append(node.get(attribute, "") if attribute else node.text or "")
            assert len(self.queues[tag]) <= self.limit, "a queue is full"

    def LIN(self, frame: Frame) -> None:
        self.poses.append(frame.numbers())
        if len(self.poses) >= 3 * self.picks:  # above, at, above
            self.poses = self.poses[1::3]
            raise DoneError


class _Timers:
    def __init__(self, controller: KukaController) -> None:
        self._controller = controller

    def __setitem__(self, _number: int, milliseconds: float) -> None:
        left = -milliseconds / 1000 * self._controller.patience
        self._controller.deadline = time.monotonic() + left


class _TimerFlags:
    def __init__(self, controller: KukaController) -> None:
        self._controller = controller

    def __getitem__(self, _number: int) -> bool:
        return time.monotonic() > self._controller.deadline


class Reals(list[float]):
    """An ARRAY OF REAL, counted from 1."""

    def __init__(self, size: int) -> None:
        super().__init__([0.0] * (size + 1))


class FanucController(Controller):
    """Fanuc with socket messaging: KAREL Reference Manual, file input and output.

    ``READ`` of a string reads to the end of the line, a carriage return; what is longer than the
    string is cut. A TP program beside it asks by registers.
    """

    example = "smartcam.kl"

    def __init__(self, port: int, picks: int, **more: Any) -> None:
        super().__init__(port, picks, **more)
        self.registers: dict[Any, Any] = {20: 0, 21: 1, 22: 0}
        self._begun = False

    def _run(self) -> None:
        names = self._names()
        names |= {"Reals": Reals, "CR": "\r\n", "ROUND": round, "STR_LEN": len, "gateway": None}
        self._execute(from_karel((ROBOTS / self.example).read_text()), self.example, names)
        names["smartcam"]()

    def MSG_CONNECT(self, tag: str) -> int:
        assert re.fullmatch("C[1-8]:", tag)
        return 0 if self.wire.open() else 67_213

    def MSG_DISCO(self, _tag: str) -> int:
        self.wire.close()
        return 0

    def OPEN_FILE(self, mode: str, tag: str) -> str:
        assert mode == "RW"
        return tag

    def CLOSE_FILE(self) -> None: ...

    def IO_STATUS(self, _file: object) -> int:
        return 0 if self.wire.sock else 2

    def WRITE(self, *items: str) -> None:
        self.wire.send("".join(items).encode())

    def BYTES_AHEAD(self, _file: object) -> tuple[int, int]:
        if not self.wire.came:
            self.wire.receive(0.02 * self.patience)
        return len(self.wire.came), 0

    def READ(self, size: int) -> str:
        while b"\r" not in self.wire.came:
            if not self.wire.receive(5.0):
                break
        line, _, self.wire.came = self.wire.came.partition(b"\r")
        assert len(line) <= 254, "a STRING has 254 characters at most"
        return line.decode("ascii")[:size]

    def DELAY(self, milliseconds: int) -> None:
        """Wait, but not here: what is waited for takes its time in BYTES_AHEAD."""

    def SUB_STR(self, text: str, begin: int, count: int) -> str:
        return text[begin - 1 : begin - 1 + count]

    def CNV_STR_REAL(self, text: str) -> float:
        try:
            return real(float(text))
        except ValueError:
            return math.nan

    def CNV_STR_CONF(self, text: str) -> tuple[str, int]:
        return text, 0

    def POS(self, *numbers: Any) -> list[float]:
        assert numbers[-1] == "NUT000"
        return list(numbers[:-1])

    def GET_REG(self, number: int) -> tuple[bool, int, float, int]:
        """Tell what is asked; between two answers the TP program moves, and asks anew."""
        if self.registers[number] == 0:
            code, further = self.registers[21], False
            if self._begun and code == 0:
                further = True
                self.poses.append(self.registers["part"])
                if len(self.poses) >= self.picks:
                    raise DoneError
            elif self._begun and code > 1:
                self.failed(code)
            self._begun = True
            self.registers[number] = 2 if further else 1
        return False, self.registers[number], 0.0, 0

    def SET_INT_REG(self, number: int, value: int) -> int:
        self.registers[number] = value
        return 0

    def SET_POS_REG(self, number: int, part: list[float]) -> int:
        assert number == 20
        self.registers["part"] = part
        return 0


class _Block:
    """A communication block of STEP 7: outputs are set by a call."""

    def __init__(self, plc: SiemensController) -> None:
        self.plc = plc
        self.DONE = self.BUSY = self.ERROR = self.Q = False


class _Send(_Block):
    _before = False

    def __call__(
        self, *, REQ: bool, CONT: bool, LEN: int, CONNECT: object, DATA: list[str]
    ) -> None:
        self.DONE = self.ERROR = False
        wire = self.plc.wire
        if not CONT:
            wire.close()
        elif wire.sock is None:
            self.ERROR = not wire.open() and REQ
        if REQ and not self._before and wire.sock is not None:
            assert len(DATA) >= LEN
            self.DONE = wire.send("".join(DATA[:LEN]).encode())
        self._before = REQ


class _Receive(_Block):
    def __call__(
        self, *, EN_R: bool, CONT: bool, LEN: int, CONNECT: object, DATA: list[str]
    ) -> None:
        """Receive as many bytes as are asked for: fewer are waited for."""
        self.DONE = False
        wire = self.plc.wire
        if EN_R and CONT:
            wire.receive(0.01)
            if len(wire.came) >= LEN:
                DATA[:] = wire.came[:LEN].decode("ascii")
                wire.came, self.DONE = wire.came[LEN:], True


class _Timer(_Block):
    _since = 0.0

    def __call__(self, *, IN: bool, PT: float) -> None:
        now = time.monotonic()
        self._since = self._since or now if IN else 0.0
        self.Q = IN and now - self._since >= PT * self.plc.patience


class SiemensController(Controller):
    """An S7-1500: TSEND_C, TRCV_C, which send and receive arrays of a fixed length."""

    example = "SmartcamGateway.scl"

    def _run(self) -> None:
        names: dict[str, Any] = {"CHAR_TO_INT": ord, "INT_TO_REAL": float, "REAL_TO_INT": round}
        self._execute(from_scl((ROBOTS / self.example).read_text()), self.example, names)
        block = self._instance()
        while len(self.poses) < self.picks:
            block.execute = True
            names["cycle"](block)
            while not block.done:
                names["cycle"](block)
            block.execute = False
            names["cycle"](block)
            block.further = block.code == 0
            if block.code == 0:
                self.poses.append([real(one) for one in block.values[3:9]])
            elif block.code > 1:
                self.failed(block.code)
        raise DoneError

    def _instance(self) -> Any:
        class Instance: ...

        block = Instance()
        vars(block).update(
            execute=False, further=False, connection=object(), done=False, busy=False, code=0,
            remaining=0, values=[0.0] * 9, state=0, before=False, sender=_Send(self),
            receiver=_Receive(self), timer=_Timer(self), request=[""] * 32, answer=[""] * 96,
            NO_ANSWER=99,
        )  # fmt: skip
        return block
