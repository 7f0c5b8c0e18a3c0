"""The emulated ifm sensor: applications, triggers, layouts of sessions, images."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from smartcam._arguments import check_choice, check_integer, check_seconds
from smartcam.emulator import TicketedCamera, TicketedClient
from smartcam.emulator._inside import EvaluatingCamera, applications_of, request
from smartcam.exceptions import ConfigurationError
from smartcam.makes._ifm.chunks import JPEG, MONO8, ImageChunk
from smartcam.makes._ifm.dialect import (
    ASYNCHRONOUS,
    ERRORS,
    MAX_INPUT_BYTES,
    NOTIFICATIONS,
    OVERRUN,
    PCIC,
    RESULTS,
)
from smartcam.makes._ifm.layouts import check_layout, encode

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from smartcam.emulator import LineClient
    from smartcam.protocols import LineRow

INPUT_CONTAINERS = 10
_KINDS: Mapping[type, str] = {str: "string", bool: "uint8", int: "int32"}
_NETWORK = ("255.255.255.0", "0.0.0.0", "00:02:01:00:00:01", "0", "80")  # noqa: S104


@dataclass(frozen=True, kw_only=True)
class IfmApplication:
    """An application of an emulated sensor, from its options.

    Attributes:
        id: number, 1 to 99.
        parts: the values of each evaluation by the ids of elements; records are lists of mappings.
        processing_time: seconds of an evaluation.
        trigger: trigger of evaluations: ``"process"``, ``"continuous"`` or ``"hardware"``.
        images: number of pictures of an evaluation.
        jpeg: path or bytes of a JPEG file for all pictures; without it, grey levels.
    """

    id: int
    parts: Sequence[Mapping[str, Any]] = ({"x": 12.5, "y": -3.0, "quality": 0.97},)
    processing_time: float = 0.01
    trigger: str = "process"
    images: int = 1
    jpeg: str | bytes = b""

    def __post_init__(self) -> None:
        check_integer(self.id, "id", 1, 99)
        check_seconds(self.processing_time, "processing_time")
        check_integer(self.images, "images", 0, 20)
        check_choice(self.trigger, "trigger", ("process", "continuous", "hardware"))
        if isinstance(self.jpeg, str):
            try:
                object.__setattr__(self, "jpeg", Path(self.jpeg).read_bytes())
            except OSError as exc:
                raise ConfigurationError(f"jpeg: {exc}") from exc

    def picture(self, count: int, time: float) -> ImageChunk:
        """Return a picture of an evaluation."""
        if isinstance(self.jpeg, bytes) and self.jpeg:
            size = re.search(rb"\xff[\xc0\xc2].{3}(..)(..)", self.jpeg, re.DOTALL)
            sides = size.groups() if size else (b"", b"")
            height, width = (int.from_bytes(side, "big") for side in sides)
            return ImageChunk(JPEG, width, height, count, time, self.jpeg)
        levels = np.add.outer(np.arange(48), np.arange(64) + count).astype(np.uint8)
        return ImageChunk(MONO8, 64, 48, count, time, levels.tobytes())


class IfmClient(TicketedClient):
    """A client of an emulated sensor: the layout and the outputs of its session."""

    outputs: int = 1
    layout: Mapping[str, Any]


class EmulatedIfm(EvaluatingCamera, TicketedCamera):
    """An emulated sensor of ifm that evaluates the same parts again and again.

    Args:
        applications: numbers of its applications, or mappings of the fields of
            :class:`IfmApplication`.
        active: number of the active application; None for the first one, 0 for none.
        version: version of PCIC that sessions begin with, 1 to 4.
        defaults: fields of :class:`IfmApplication` for all applications.
        options: the options of :class:`~smartcam.emulator.LineCamera`.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    protocol = PCIC
    client_class: ClassVar[type[TicketedClient]] = IfmClient
    also_hears: ClassVar[tuple[LineRow, ...]] = (ASYNCHRONOUS,)

    def __init__(
        self,
        *,
        applications: Iterable[int | Mapping[str, Any]] = (1, 2),
        active: int | None = None,
        version: int = 3,
        defaults: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        made = applications_of(IfmApplication, applications, defaults)
        self.set_up({each.id: each.parts for each in made}, active, 0)
        self.applications: Mapping[int, IfmApplication] = {each.id: each for each in made}
        self.version: int = check_integer(version, "version", 1, 4)
        self.error = 0
        self.results: int = 0
        self.good: int = 0
        self.inputs: list[str] = [""] * INPUT_CONTAINERS
        self.values: Mapping[str, Any] = {}
        self._outputs: dict[str, str] = {}
        super().__init__(**options)

    @property
    def application(self) -> IfmApplication:
        """The active application."""
        return self.applications.get(self.active, IfmApplication(id=99, images=0))

    # ------------------------------------------------------------------ sessions

    def make_client(self, link: Any, server: Any) -> LineClient:
        """Return a new client, with the device's own layout."""
        client = cast("IfmClient", super().make_client(link, server))
        client.speak(f"v{self.version}")
        client.layout = self.own_layout()
        return client

    def own_layout(self) -> Mapping[str, Any]:
        """Return the device's own layout: the values of a part as ASCII, between two words."""
        semicolon = {"type": "string", "id": "delimiter", "value": ";"}
        elements: list[dict[str, Any]] = [{"type": "string", "id": "begin", "value": "star"}]
        for key, value in self.application.parts[0].items():
            if not isinstance(value, (list, tuple, bytes)):
                elements += (semicolon, {"type": _KINDS.get(type(value), "float32"), "id": key})
        elements += (semicolon, {"type": "string", "id": "end", "value": "stop"})
        form = {"dataencoding": "ascii"}
        return {"layouter": "flexible", "format": form, "elements": elements}

    def hear(self, client: LineClient, line: str) -> None:
        """Carry out a request; during a long one, further requests are read."""
        call = cast("IfmClient", client.answer_later())
        untold = call.dialect.tickets and not call.ticket
        call.answer("?") if untold else super().hear(call, line)

    def unknown(self, line: str) -> str:
        """Return the answer to an unknown command."""
        return "?"

    # ------------------------------------------------------------------ evaluations

    @property
    def evaluation_time(self) -> float:
        """Seconds of an evaluation."""
        return self.application.processing_time

    def evaluated(self, call: LineClient | None, part: Mapping[str, Any]) -> None:
        """Answer with the result, and send it to all clients that have switched results on."""
        self.values = part
        self.results += 1
        self.good += bool(part.get("passed", True))
        asker = None if call is None else cast("IfmClient", call).session
        if call is not None:
            call.answer(self._encoded(cast("IfmClient", call)))
        self.tell(RESULTS, self._encoded, lambda client: client.outputs & 1 and client is not asker)

    def _encoded(self, client: IfmClient) -> str:
        try:
            return encode(client.layout, self.values).decode("latin-1")
        except (TypeError, ValueError, AttributeError, struct.error):
            return "!"

    def voided(self, call: LineClient) -> None:
        """Refuse a trigger whose evaluation is interrupted by a switch."""
        call.answer("!")

    def overrun(self) -> None:
        """Report that a trigger came too early."""
        self.tell(ERRORS, lambda _: f"{OVERRUN}:Trigger overrun", lambda client: client.outputs & 2)

    def activate(self, application: int) -> None:
        """Make another application the active one, and report that."""
        super().activate(application)
        text = json.dumps({"Index": application})
        self.tell(NOTIFICATIONS, lambda _: f"000500000:{text}", lambda client: client.outputs & 4)

    def activated(self) -> None:
        """Start evaluating, if the active application runs continuously."""
        if self.active and self.application.trigger == "continuous":
            self.begin(None)

    @property
    def takes_trigger(self) -> bool:
        """True if the process interface may trigger."""
        return not self.busy and self.active != 0 and self.application.trigger == "process"

    # ------------------------------------------------------------------ requests

    @request(r"t")
    def _start(self, call: IfmClient) -> str:
        """Start an evaluation; its result is sent to all clients that have switched results on."""
        if not self.takes_trigger:
            return "!"
        self.begin(None)
        return "*"

    @request(r"T\?")
    def _trigger(self, call: IfmClient) -> str | None:
        """Start an evaluation and answer with its result."""
        if not self.takes_trigger:
            return "!"
        self.begin(call)
        return None

    @request(r"p([0-7])")
    def _p(self, call: IfmClient, outputs: str) -> str:
        """Switch results (1), errors (2) and notifications (4) of this session on."""
        call.session.outputs = int(outputs)
        return "*"

    @request(r"A\?")
    def _apps(self, call: IfmClient) -> str:
        """Return the count of applications, the active one, and all their numbers."""
        numbers = [f"{len(self.applications):03}", f"{self.active:02}"]
        return "\t".join([*numbers, *(f"{application:02}" for application in self.applications)])

    @request(r"a(\d\d)")
    def _a(self, call: IfmClient, number: str) -> str:
        """Make another application the active one."""
        if int(number) not in self.applications:
            return "!"
        self.activate(int(number))
        return "*"

    @request(r"E\?")
    def _error(self, call: IfmClient) -> str:
        """Return the present error as nine digits, all zeros for none."""
        return f"{self.error:09}"

    @request(r"S\?")
    def _stats(self, call: IfmClient) -> str:
        """Return the counts of all results, of the good ones, and of the bad ones."""
        counts = (self.results, self.good, self.results - self.good)
        return "\t".join(f"{count:010}" for count in counts) if self.active else "!"

    @request(r"G\?")
    def _identity(self, call: IfmClient) -> str:
        """Return maker, article, name, place, description, address, ports and time settings."""
        return "\t".join(
            ("IFM ELECTRONIC", "O2D500", self.name, "emulated", "", self.host, *_NETWORK)
        )

    @request(r"H\?")
    def _help(self, call: IfmClient) -> str:
        """Return this list."""
        words = re.compile(r"\\d\{\d\}|\\d\\d|\(\S*?\)|\\")
        each = {
            words.sub("", form.pattern): handler.__doc__ for form, handler in self.requests.items()
        }
        return "\n".join(f"{form:<4} {text}" for form, text in each.items())

    @request(r"I(\d\d)\?")
    def _image(self, call: IfmClient, kind: str) -> str:
        """Return the last image: 01 as JPEG files, 02 as grey levels."""
        application, now = self.application, self.clock.now
        if kind != ("01" if application.jpeg else "02"):
            return "!"
        counts = range(self.results, self.results + application.images)
        data = b"".join(application.picture(count, now).encoded for count in counts).decode(
            "latin-1"
        )
        return _counted(data) if data else "!"

    @request(r"c(\d{9})(.*)")
    def _c(self, call: IfmClient, length: str, text: str) -> str:
        """Set the layout of this session's results, from JSON with its length."""
        if int(length) != len(text):
            return "!"
        try:
            call.session.layout = check_layout(text)
        except (ValueError, RecursionError):
            return "!"
        return "*"

    @request(r"C\?")
    def _layout(self, call: IfmClient) -> str:
        """Return the layout of this session with its length."""
        return _counted(json.dumps(call.layout))

    @request(r"j(0\d)(\d{9})(.*)")
    def _j(self, call: IfmClient, number: str, length: str, text: str) -> str:
        """Put a text with its length into an input container, 00 to 09."""
        if int(length) != len(text) or len(text) > MAX_INPUT_BYTES:
            return "!"
        self.inputs[int(number)] = text
        return "*"

    @request(r"J(0\d)\?")
    def _text(self, call: IfmClient, number: str) -> str:
        """Return the text in an input container, with its length."""
        return _counted(self.inputs[int(number)])

    @request(r"g[01]|d[01]\d{3}")
    def _star(self, call: IfmClient) -> str:
        """Open or close the gate of a trigger that lasts; switch the view indicators."""
        return "*"

    @request(r"o(0[1-4])([01])")
    def _o(self, call: IfmClient, pin: str, state: str) -> str:
        """Set an output."""
        self._outputs[pin] = state
        return "*"

    @request(r"O(0[1-4])\?")
    def _output(self, call: IfmClient, pin: str) -> str:
        """Return the state of an output."""
        return pin + self._outputs.get(pin, "0")

    @request(r"L\?")
    def _session(self, call: IfmClient) -> str:
        """Return the number of this session."""
        return f"{call.number:03}"

    @request(r"V\?")
    def _versions(self, call: IfmClient) -> str:
        """Return the version of the protocol, and the versions that can be set."""
        version = int(call.dialect.name[1:])
        return f"{version:02} 01 02 03" if version < 4 else "04 01 04"

    @request(r"v0([1-4])")
    def _v(self, call: IfmClient, version: str) -> str:
        """Set the version of the protocol for this session."""
        call.session.speak(f"v{version}")
        return "*"

    @request(r"v\d\d|[jJoO]\d\d.*")
    def _no_such(self, call: IfmClient) -> str:
        """Refuse a version, an input container or an output that the device does not have."""
        return "!"


def _counted(text: str) -> str:
    """Return a text after its length."""
    return f"{len(text):09}{text}"
