"""The emulated ifm sensor, with applications, triggers, layouts of sessions and images."""

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
    ASYNCHRONOUS_TRIGGER,
    ERROR_TICKET,
    MAX_INPUT_BYTES,
    NOTIFICATION_TICKET,
    OVERRUN,
    PCIC,
    RESULT_TICKET,
)
from smartcam.makes._ifm.layouts import check_layout, encode

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from smartcam.emulator import LineClient
    from smartcam.protocols import LineRow

INPUT_CONTAINER_COUNT = 10
_ELEMENT_TYPES: Mapping[type, str] = {str: "string", bool: "uint8", int: "int32"}
"""ifm's names of the types of values; values of other types are ``float32``."""

_NETWORK_SETTINGS = ("255.255.255.0", "0.0.0.0", "00:02:01:00:00:01", "0", "80")  # noqa: S104
"""Settings after the address in the answer to ``G?``."""


@dataclass(frozen=True, kw_only=True)
class IfmApplication:
    """An application of an emulated sensor, from its options.

    Attributes:
        id: number, 1 to 99.
        parts: the workpieces that are evaluated in turn: the values of each one's result, by ids of
            layout elements; records are lists of mappings.
        processing_time: seconds of an evaluation.
        trigger: trigger of evaluations: ``"process"``, ``"continuous"`` or ``"hardware"``.
        images: number of pictures of an evaluation.
        jpeg: path or bytes of a JPEG file for all pictures; without it, pictures are grey levels.
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
        """Return picture number ``count`` since the device began, taken at a time."""
        if isinstance(self.jpeg, bytes) and self.jpeg:
            match = re.search(rb"\xff[\xc0\xc2].{3}(..)(..)", self.jpeg, re.DOTALL)
            side_bytes = match.groups() if match else (b"", b"")
            height, width = (int.from_bytes(side, "big") for side in side_bytes)
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
    also_hears: ClassVar[tuple[LineRow, ...]] = (ASYNCHRONOUS_TRIGGER,)

    def __init__(
        self,
        *,
        applications: Iterable[int | Mapping[str, Any]] = (1, 2),
        active: int | None = None,
        version: int = 3,
        defaults: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        built_applications = applications_of(IfmApplication, applications, defaults)
        self.set_up(
            {application.id: application.parts for application in built_applications}, active, 0
        )
        self.applications: Mapping[int, IfmApplication] = {
            application.id: application for application in built_applications
        }
        self.version: int = check_integer(version, "version", 1, 4)
        self.error = 0
        self.results: int = 0
        self.good: int = 0
        self.inputs: list[str] = [""] * INPUT_CONTAINER_COUNT
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
        """Return the device's own layout: a part's values as ASCII, from ``star`` to ``stop``."""
        semicolon = {"type": "string", "id": "delimiter", "value": ";"}
        elements: list[dict[str, Any]] = [{"type": "string", "id": "begin", "value": "star"}]
        for key, value in self.application.parts[0].items():
            if not isinstance(value, (list, tuple, bytes)):
                elements += (
                    semicolon,
                    {"type": _ELEMENT_TYPES.get(type(value), "float32"), "id": key},
                )
        elements += (semicolon, {"type": "string", "id": "end", "value": "stop"})
        element_format = {"dataencoding": "ascii"}
        return {"layouter": "flexible", "format": element_format, "elements": elements}

    def hear(self, client: LineClient, line: str) -> None:
        """Answer a request; while the answer is awaited, further requests are read."""
        call = cast("IfmClient", client.answer_later())
        lacks_ticket = call.dialect.tickets and not call.ticket
        call.answer("?") if lacks_ticket else super().hear(call, line)

    def unknown(self, line: str) -> str:
        """Return the answer to an unknown command."""
        return "?"

    # ------------------------------------------------------------------ evaluations

    @property
    def evaluation_time(self) -> float:
        """Seconds of an evaluation."""
        return self.application.processing_time

    def report_evaluation(self, call: LineClient | None, part: Mapping[str, Any]) -> None:
        """Answer the trigger, and send the result to all clients that have switched results on."""
        self.values = part
        self.results += 1
        self.good += bool(part.get("passed", True))
        asking_client = None if call is None else cast("IfmClient", call).session
        if call is not None:
            call.answer(self._encode_result(cast("IfmClient", call)))
        self.tell(
            RESULT_TICKET,
            self._encode_result,
            lambda client: client.outputs & 1 and client is not asking_client,
        )

    def _encode_result(self, client: IfmClient) -> str:
        try:
            return encode(client.layout, self.values).decode("latin-1")
        except (TypeError, ValueError, AttributeError, struct.error):
            return "!"

    def voided(self, call: LineClient) -> None:
        """Refuse a trigger whose evaluation a switch of the application has interrupted."""
        call.answer("!")

    def overrun(self) -> None:
        """Report that a trigger came too early."""
        self.tell(
            ERROR_TICKET, lambda _: f"{OVERRUN}:Trigger overrun", lambda client: client.outputs & 2
        )

    def activate(self, application: int) -> None:
        """Make another application the active one; notify the clients."""
        super().activate(application)
        text = json.dumps({"Index": application})
        self.tell(
            NOTIFICATION_TICKET, lambda _: f"000500000:{text}", lambda client: client.outputs & 4
        )

    def activated(self) -> None:
        """Start evaluating, if the active application runs continuously."""
        if self.active and self.application.trigger == "continuous":
            self.begin_evaluation(None)

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
        self.begin_evaluation(None)
        return "*"

    @request(r"T\?")
    def _trigger(self, call: IfmClient) -> str | None:
        """Start an evaluation and answer with its result."""
        if not self.takes_trigger:
            return "!"
        self.begin_evaluation(call)
        return None

    @request(r"p([0-7])")
    def _choose_messages(self, call: IfmClient, outputs: str) -> str:
        """Switch results (1), errors (2) and notifications (4) of this session on."""
        call.session.outputs = int(outputs)
        return "*"

    @request(r"A\?")
    def _list_applications(self, call: IfmClient) -> str:
        """Return the count of applications, the active one, and all their numbers."""
        numbers = [f"{len(self.applications):03}", f"{self.active:02}"]
        return "\t".join([*numbers, *(f"{application:02}" for application in self.applications)])

    @request(r"a(\d\d)")
    def _switch_application(self, call: IfmClient, number: str) -> str:
        """Make another application the active one."""
        if int(number) not in self.applications:
            return "!"
        self.activate(int(number))
        return "*"

    @request(r"E\?")
    def _read_error(self, call: IfmClient) -> str:
        """Return the present error as nine digits, all zeros for none."""
        return f"{self.error:09}"

    @request(r"S\?")
    def _count_results(self, call: IfmClient) -> str:
        """Return the counts of all results, of the good ones, and of the bad ones."""
        counts = (self.results, self.good, self.results - self.good)
        return "\t".join(f"{count:010}" for count in counts) if self.active else "!"

    @request(r"G\?")
    def _identify(self, call: IfmClient) -> str:
        """Return maker, article, name, place, description, address, ports and time settings."""
        return "\t".join(
            ("IFM ELECTRONIC", "O2D500", self.name, "emulated", "", self.host, *_NETWORK_SETTINGS)
        )

    @request(r"H\?")
    def _list_requests(self, call: IfmClient) -> str:
        """Return the list of all requests."""
        groups = re.compile(r"\\d\{\d\}|\\d\\d|\(\S*?\)|\\")
        texts = {
            groups.sub("", form.pattern): handler.__doc__ for form, handler in self.requests.items()
        }
        return "\n".join(f"{form:<4} {text}" for form, text in texts.items())

    @request(r"I(\d\d)\?")
    def _read_image(self, call: IfmClient, kind: str) -> str:
        """Return the last image: 01 as JPEG files, 02 as grey levels."""
        application, now = self.application, self.clock.now
        if kind != ("01" if application.jpeg else "02"):
            return "!"
        counts = range(self.results, self.results + application.images)
        data = b"".join(application.picture(count, now).encoded for count in counts).decode(
            "latin-1"
        )
        return _with_length(data) if data else "!"

    @request(r"c(\d{9})(.*)")
    def _set_layout(self, call: IfmClient, length: str, text: str) -> str:
        """Set the layout of this session's results, from JSON with its length."""
        if int(length) != len(text):
            return "!"
        try:
            call.session.layout = check_layout(text)
        except (ValueError, RecursionError):
            return "!"
        return "*"

    @request(r"C\?")
    def _read_layout(self, call: IfmClient) -> str:
        """Return the layout of this session with its length."""
        return _with_length(json.dumps(call.layout))

    @request(r"j(0\d)(\d{9})(.*)")
    def _write_input(self, call: IfmClient, number: str, length: str, text: str) -> str:
        """Put a text with its length into an input container, 00 to 09."""
        if int(length) != len(text) or len(text) > MAX_INPUT_BYTES:
            return "!"
        self.inputs[int(number)] = text
        return "*"

    @request(r"J(0\d)\?")
    def _read_input(self, call: IfmClient, number: str) -> str:
        """Return the text in an input container, with its length."""
        return _with_length(self.inputs[int(number)])

    @request(r"g[01]|d[01]\d{3}")
    def _accept(self, call: IfmClient) -> str:
        """Accept a request without any effect: a trigger's gate, or the view indicators."""
        return "*"

    @request(r"o(0[1-4])([01])")
    def _set_output(self, call: IfmClient, pin: str, state: str) -> str:
        """Set an output."""
        self._outputs[pin] = state
        return "*"

    @request(r"O(0[1-4])\?")
    def _read_output(self, call: IfmClient, pin: str) -> str:
        """Return the state of an output."""
        return pin + self._outputs.get(pin, "0")

    @request(r"L\?")
    def _session_number(self, call: IfmClient) -> str:
        """Return the number of this session."""
        return f"{call.number:03}"

    @request(r"V\?")
    def _list_versions(self, call: IfmClient) -> str:
        """Return the version of the protocol, and the versions that can be set."""
        version = int(call.dialect.name[1:])
        return f"{version:02} 01 02 03" if version < 4 else "04 01 04"

    @request(r"v0([1-4])")
    def _set_version(self, call: IfmClient, version: str) -> str:
        """Set the version of the protocol for this session."""
        call.session.speak(f"v{version}")
        return "*"

    @request(r"v\d\d|[jJoO]\d\d.*")
    def _refuse_missing(self, call: IfmClient) -> str:
        """Refuse a version, an input container or an output that the device does not have."""
        return "!"


def _with_length(text: str) -> str:
    """Return a text preceded by its length, in nine digits."""
    return f"{len(text):09}{text}"
