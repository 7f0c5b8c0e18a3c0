"""The emulated ifm sensor: applications, triggers, layouts of sessions, images."""

from __future__ import annotations

import itertools
import json
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from smartcam._arguments import check_integer, check_seconds
from smartcam.emulator import TicketedCamera, TicketedClient
from smartcam.exceptions import ConfigurationError
from smartcam.makes._ifm.chunks import JPEG, MONO8, ImageChunk
from smartcam.makes._ifm.dialect import (
    ASYNCHRONOUS,
    ERRORS,
    OVERRUN,
    PCIC,
    RESULTS,
    V1,
    V2,
    V3,
    V4,
)
from smartcam.makes._ifm.layouts import check_layout, encode

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from smartcam.emulator import LineClient
    from smartcam.protocols import LineRow, TicketedDialect

VERSIONS: Mapping[int, TicketedDialect] = {1: V1, 2: V2, 3: V3, 4: V4}
SOURCES = ("process", "continuous", "hardware")
CONTAINERS, MAX_TEXT = 10, 256
_KINDS: Mapping[type, str] = {str: "string", bool: "uint8", int: "int32"}

COMMANDS: Mapping[str, str] = {
    r"t": "start an evaluation; its result is sent to whoever has results switched on",
    r"T\?": "start an evaluation and answer with its result",
    r"p([0-7])": "switch the output of results (1), errors (2) and notifications (4) of a session",
    r"A\?": "tell how many applications there are, which one is active, and all their numbers",
    r"a(\d\d)": "make another application the active one",
    r"E\?": "tell the present error as nine digits, all zeros for none",
    r"S\?": "tell how many results there were, how many of them good, and how many bad",
    r"G\?": "tell maker, article, name, place, description, address, ports and time settings",
    r"H\?": "tell this list",
    r"I(\d\d)\?": "tell the last image: 01 as JPEG files, 02 as grey levels",
    r"c(\d{9})(.*)": "take a layout for the results of this session, as JSON with its length",
    r"C\?": "tell the layout of this session with its length",
    r"j(\d\d)(\d{9})(.*)": "put a text with its length into an input container, 00 to 09",
    r"J(\d\d)\?": "tell the text in an input container, with its length",
    r"g([01])": "open or close the gate of a trigger that lasts",
    r"o(\d\d)([01])": "set an output",
    r"O(\d\d)\?": "tell the state of an output",
    r"d([01])(\d{3})": "switch the view indicators on for some seconds, or off",
    r"L\?": "tell the number of this session",
    r"V\?": "tell the version of the protocol, and those that can be set",
    r"v(\d\d)": "set the version of the protocol for this session",
}
"""Requests, each a form of its whole content, and what it does; the method in the same place."""


@dataclass(frozen=True, kw_only=True)
class IfmApplication:
    """An application of an emulated sensor, as its options say.

    Attributes:
        id: number, 1 to 99.
        parts: the values of each evaluation by the ids of elements; records are lists of mappings.
        processing_time: seconds of an evaluation.
        trigger: what starts evaluations: ``"process"``, ``"continuous"`` or ``"hardware"``.
        images: pictures of an evaluation.
        jpeg: path of a JPEG file that each picture is, or its bytes; none for grey levels.
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
        if self.trigger not in SOURCES:
            known = ", ".join(SOURCES)
            raise ConfigurationError(f"trigger: one of {known} was expected, got {self.trigger!r}")
        if not self.parts:
            raise ConfigurationError("parts: at least one was expected")
        if isinstance(self.jpeg, str):
            try:
                object.__setattr__(self, "jpeg", Path(self.jpeg).read_bytes())
            except OSError as exc:
                raise ConfigurationError(f"jpeg: {exc}") from exc

    def picture(self, count: int, time: float) -> ImageChunk:
        """Return a picture of an evaluation."""
        if isinstance(self.jpeg, bytes) and self.jpeg:
            size = re.search(rb"\xff[\xc0\xc2].{3}(..)(..)", self.jpeg, re.DOTALL)
            found = size.groups() if size else (b"", b"")
            height, width = (int.from_bytes(one, "big") for one in found)
            return ImageChunk(JPEG, width, height, count, time, self.jpeg)
        levels = np.add.outer(np.arange(48), np.arange(64) + count).astype(np.uint8)
        return ImageChunk(MONO8, 64, 48, count, time, levels.tobytes())


class IfmClient(TicketedClient):
    """A client of an emulated sensor: what lasts for its session."""

    number: int = 0
    outputs: int = 1
    layout: Mapping[str, Any]


class IfmDevice:
    """The operator of an emulated camera: what is done at the device itself."""

    def __init__(self, camera: EmulatedIfm) -> None:
        self._camera = camera

    def trigger(self) -> None:
        """Trigger at the input; while an evaluation is under way it is an overrun."""
        self._camera.overrun() if self._camera.busy else self._camera.begin(None)

    def switch_application(self, application: int, running: bool = False) -> None:
        """Make another application the active one."""
        self._camera.activate(application)


class EmulatedIfm(TicketedCamera):
    """An emulated sensor of ifm that evaluates the same parts over and over.

    Args:
        applications: numbers of its applications, or mappings of the fields of
            :class:`IfmApplication`.
        active: number of the active one; None for the first one, 0 for none.
        version: version of PCIC that sessions begin with, 1 to 4.
        defaults: fields of :class:`IfmApplication` for all applications.
        options: the options of :class:`~smartcam.emulator.LineCamera`.

    Raises:
        ConfigurationError: something given is wrong.
    """

    protocol = PCIC
    also_hears: ClassVar[tuple[LineRow, ...]] = (ASYNCHRONOUS,)
    busy: bool = False

    def __init__(
        self,
        *,
        applications: Iterable[int | Mapping[str, Any]] = (1, 2),
        active: int | None = None,
        version: int = 3,
        defaults: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        given = [{"id": one} if isinstance(one, int) else one for one in applications]
        try:
            made = [IfmApplication(**{**(defaults or {}), **one}) for one in given]
        except TypeError as exc:
            raise ConfigurationError(f"applications: {exc}") from exc
        self.applications: Mapping[int, IfmApplication] = {one.id: one for one in made}
        self.active: int = next(iter(self.applications), 0) if active is None else active
        if self.active not in {0, *self.applications}:
            raise ConfigurationError(
                f"active: one of {[*self.applications]} was expected, got {active!r}"
            )
        self.parts: dict[int, itertools.cycle[Mapping[str, Any]]] = {
            one.id: itertools.cycle(one.parts) for one in made
        }
        self.version: int = check_integer(version, "version", 1, 4)
        self.error = 0
        self.results: int = 0
        self.good: int = 0
        self.inputs: list[str] = [""] * CONTAINERS
        self.values: Mapping[str, Any] = {}
        self._outputs: dict[str, str] = {}
        self._sessions = itertools.count(1)
        self._call: IfmClient | None = None  # which the evaluation under way answers
        self._run = 0  # an application that is switched voids the evaluation under way
        self.device: Any = IfmDevice(self)
        handlers: tuple[Callable[..., str | None], ...] = (
            *(self._t, self._trigger, self._p, self._apps, self._a, self._error, self._stats),
            *(self._who, self._help, self._image, self._c, self._layout, self._j, self._text),
            *(
                self._star,
                self._o,
                self._output,
                self._star,
                self._session,
                self._versions,
                self._v,
            ),
        )
        self._handlers = [
            (re.compile(form, re.DOTALL), one) for form, one in zip(COMMANDS, handlers, strict=True)
        ]
        super().__init__(**options)

    @classmethod
    def state_options(cls, active: int | None, *, running: bool) -> dict[str, Any]:
        """Return the options with which an application is active."""
        return {"active": active}

    @property
    def application_ids(self) -> list[int]:
        """Numbers of its applications."""
        return list(self.applications)

    @property
    def application(self) -> IfmApplication:
        """The active application."""
        return self.applications.get(self.active, IfmApplication(id=99, images=0))

    # ------------------------------------------------------------------ sessions

    def make_client(self, link: Any, server: Any) -> LineClient:
        """Return a new client, with the device's own layout."""
        client = IfmClient(self, link, server)
        client.dialect, client.number = VERSIONS[self.version], next(self._sessions)
        client.layout = self.own_layout()
        return client

    def own_layout(self) -> Mapping[str, Any]:
        """Return the device's own layout: the values of a part as ASCII, between two words."""
        semicolon = {"type": "string", "id": "delimiter", "value": ";"}
        part = self.application.parts[0]
        values = [
            one
            for key, value in part.items()
            if not isinstance(value, (list, tuple, bytes))
            for one in (
                {"type": _KINDS.get(type(value), "float32"), "id": key},
                semicolon,
            )
        ]
        words = [
            {"type": "string", "id": f"{one}_string", "value": one} for one in ("star", "stop")
        ]
        return {
            "layouter": "flexible",
            "format": {"dataencoding": "ascii"},
            "elements": [words[0], semicolon, *values, words[1]],
        }

    def hear(self, client: LineClient, line: str) -> None:
        """Do what a request says; a long one is answered while the next ones are heard."""
        call = cast("IfmClient", client.keep())
        answer: str | None = "?"
        if call.dialect.tickets and not call.ticket:
            call.answer("?")
            return
        for form, handler in self._handlers:
            found = form.fullmatch(line)
            if found is not None:
                answer = handler(call, *found.groups())
                break
        if answer is not None:
            call.answer(answer)
        if line.startswith("v") and answer == "*":
            cast("IfmClient", client).dialect = VERSIONS[int(line[1:])]

    def _tell(self, bit: int, ticket: str, content: Callable[[IfmClient], str], but: Any) -> None:
        for one in list(self._clients.values()):
            client = cast("IfmClient", one)
            if client.outputs & bit and client.number != but:
                client.say_bytes(client.frame(content(client), ticket), row=self._said[ticket])

    @property
    def _said(self) -> Mapping[str, int]:
        return {row.word: at for at, row in enumerate(V3.rows, 1) if row.word}

    # ------------------------------------------------------------------ evaluations

    def begin(self, call: IfmClient | None) -> None:
        """Begin an evaluation; its result answers ``call``, and goes to who has results on."""
        self.busy, self._run = True, self._run + 1
        run, self._call = self._run, call
        self.after(self.application.processing_time, lambda: self._end(call, run))

    def _end(self, call: IfmClient | None, run: int) -> None:
        if run != self._run:
            return
        self.busy, self._call = False, None
        self.values = next(self.parts[self.active])
        self.results += 1
        self.good += bool(self.values.get("passed", True))
        if call is not None and not call.gone:
            call.answer(self._encoded(call))
        self._tell(1, RESULTS, self._encoded, None if call is None else call.number)
        self._began()

    def _encoded(self, client: IfmClient) -> str:
        try:
            return encode(client.layout, self.values).decode("latin-1")
        except (TypeError, ValueError, AttributeError, struct.error):
            return "!"

    def overrun(self) -> None:
        """Tell that a trigger came too early."""
        self._tell(2, ERRORS, lambda _: f"{OVERRUN}:Trigger overrun", None)

    def activate(self, application: int) -> None:
        """Make another application the active one; the evaluation under way gives no result."""
        self.active, self.busy = application, False
        self._run += 1
        call, self._call = self._call, None
        if call is not None and not call.gone:
            call.answer("!")
        self._began()

    def _began(self) -> None:
        if self.active and self.application.trigger == "continuous":
            self.begin(None)

    @property
    def takes_trigger(self) -> bool:
        """True if the process interface may trigger."""
        return not self.busy and self.active != 0 and self.application.trigger == "process"

    def _t(self, call: IfmClient) -> str:
        if not self.takes_trigger:
            return "!"
        self.begin(None)
        return "*"

    def _trigger(self, call: IfmClient) -> str | None:
        if not self.takes_trigger:
            return "!"
        self.begin(call)
        return None

    # ------------------------------------------------------------------ other requests

    def _star(self, call: IfmClient, *said: str) -> str:
        return "*"

    def _p(self, call: IfmClient, outputs: str) -> str:
        self._of(call).outputs = int(outputs)
        return "*"

    def _of(self, call: IfmClient) -> IfmClient:
        """Return the client whose request a call is."""
        clients = cast("Iterable[IfmClient]", self._clients.values())
        return next((one for one in clients if one.number == call.number), call)

    def _apps(self, call: IfmClient) -> str:
        numbers = [f"{len(self.applications):03}", f"{self.active:02}"]
        return "\t".join([*numbers, *(f"{one:02}" for one in self.applications)])

    def _a(self, call: IfmClient, number: str) -> str:
        if int(number) not in self.applications:
            return "!"
        self.activate(int(number))
        return "*"

    def _error(self, call: IfmClient) -> str:
        return f"{self.error:09}"

    def _stats(self, call: IfmClient) -> str:
        counts = (self.results, self.good, self.results - self.good)
        return "\t".join(f"{one:010}" for one in counts) if self.active else "!"

    def _who(self, call: IfmClient) -> str:
        network = (self.host, "255.255.255.0", "0.0.0.0", "00:02:01:00:00:01", "0", "80")  # noqa: S104
        return "\t".join(("IFM ELECTRONIC", "O2D500", self.name, "emulated", "", *network))

    def _help(self, call: IfmClient) -> str:
        words = re.compile(r"\\d\{\d\}|\\d\\d|\(\S*?\)|\\")
        return "\n".join(f"{words.sub('', form):<4} {text}" for form, text in COMMANDS.items())

    def _image(self, call: IfmClient, kind: str) -> str:
        application, now = self.application, self.clock.now
        if kind != ("01" if application.jpeg else "02"):
            return "!"
        counts = range(self.results, self.results + application.images)
        data = b"".join(application.picture(one, now).encoded for one in counts).decode("latin-1")
        return f"{len(data):09}{data}" if data else "!"

    def _c(self, call: IfmClient, length: str, text: str) -> str:
        if int(length) != len(text):
            return "!"
        try:
            self._of(call).layout = check_layout(text)
        except (ValueError, RecursionError):
            return "!"
        return "*"

    def _layout(self, call: IfmClient) -> str:
        text = json.dumps(call.layout)
        return f"{len(text):09}{text}"

    def _j(self, call: IfmClient, number: str, length: str, text: str) -> str:
        if int(number) >= CONTAINERS or int(length) != len(text) or len(text) > MAX_TEXT:
            return "!"
        self.inputs[int(number)] = text
        return "*"

    def _text(self, call: IfmClient, number: str) -> str:
        if int(number) >= CONTAINERS:
            return "!"
        return f"{len(self.inputs[int(number)]):09}{self.inputs[int(number)]}"

    def _o(self, call: IfmClient, pin: str, state: str) -> str:
        if not 1 <= int(pin) <= 4:
            return "!"
        self._outputs[pin] = state
        return "*"

    def _output(self, call: IfmClient, pin: str) -> str:
        return f"{pin}{self._outputs.get(pin, '0')}" if 1 <= int(pin) <= 4 else "!"

    def _session(self, call: IfmClient) -> str:
        return f"{call.number:03}"

    def _versions(self, call: IfmClient) -> str:
        version = next(number for number, one in VERSIONS.items() if one is call.dialect)
        return f"{version:02} 01 02 03" if version < 4 else "04 01 04"

    def _v(self, call: IfmClient, version: str) -> str:
        return "*" if int(version) in VERSIONS else "!"
