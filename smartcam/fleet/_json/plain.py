"""Serve programs without smartcam: list an agent's cameras, and carry out services.

Every question is answered, except those about another agent's cameras, which that agent answers. A
service runs in a task of the agent, which ends with its deadline and with the agent.
"""

from __future__ import annotations

import asyncio
import collections
import json
import logging
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from smartcam._suggestions import did_you_mean
from smartcam._thesis import SetupRequest
from smartcam.exceptions import (
    ConfigurationError,
    ConnectionClosedError,
    ConnectionLostError,
    LocalProtocolError,
    ResponseTimeoutError,
    SmartCamError,
)
from smartcam.fleet._agent.pulse import Pulse
from smartcam.fleet._agent.shared import Owner
from smartcam.fleet._bus.address import check_name
from smartcam.fleet._bus.bus import always
from smartcam.fleet._bus.errors import late
from smartcam.fleet._bus.keys import meets
from smartcam.fleet._json.calibrations import CALIBRATIONS
from smartcam.fleet._json.services import SERVICES, UNKNOWN, PlainRequest, Service, Work
from smartcam.fleet._json.thesis import SETUP, STOP, new_camera
from smartcam.fleet._json.thesis import THESIS as CAMERA_SERVICES
from smartcam.fleet._json.topics import Topics, as_json
from smartcam.fleet._program.reading import failure
from smartcam.settings import validated

if TYPE_CHECKING:
    from smartcam.calibration._inside import CalibrationDesks
    from smartcam.fleet._agent.agent import Agent
    from smartcam.fleet._agent.host import Host
    from smartcam.fleet._bus.bus import Bus, BusQuestion, Handle
    from smartcam.fleet._bus.keys import Keys

logger: logging.Logger = logging.getLogger("smartcam.fleet")

THESIS = {**CAMERA_SERVICES, **CALIBRATIONS}
"""The services of the thesis' interface by name."""

MAX_REQUEST_BYTES = 1 << 18
"""Largest number of bytes of a request."""

MAX_CONCURRENT_CALLS = 256
"""Largest number of running commands of one camera, and of running questions."""

MAX_WAITING_REPEATS = 16
"""Largest number of questions that wait for the answer of one call."""

MAX_ANSWERS_REMEMBERED, MAX_ANSWER_BYTES_REMEMBERED = 4096, 1 << 24
"""Largest number of remembered answers of commands with an id, and of their bytes; the same for
questions, separately, so that a viewer cannot displace the answers of commands."""

MAX_CAMERAS_ADDED = 100
"""Largest number of cameras that Setup adds."""

CANCEL_GRACE = 0.5
"""Seconds beyond a service's timeout after which its task is cancelled."""

SETUP_WAIT = 600.0
"""Seconds for which Setup waits for a camera; its own timeout is shorter."""

PRESENCE_TIMEOUT = 2.0
"""Seconds of the timeout for a question about presences on the bus."""


class _Order(NamedTuple):
    """A decoded question.

    Attributes:
        camera: name of the camera of the service.
        name: name of the service.
        service: the service.
        fields: fields of the request; None if they cannot be read.
        error: error of the request; None if there is none.
        waited: seconds for which the request may have waited before it was received.
    """

    camera: str
    name: str
    service: Service
    fields: dict[str, Any] | None
    error: SmartCamError | None
    waited: float = 0.0

    @property
    def operates(self) -> bool:
        """True if only operators may use the service; otherwise viewers may, too."""
        return self.service.command or self.name not in SERVICES

    def request(self) -> Any:
        """Return the request.

        Raises:
            SmartCamError: the fields are not a valid request.
        """
        if self.error is not None:
            raise self.error
        given = {key: value for key, value in (self.fields or {}).items() if value is not None}
        return validated(self.service.request, given, f"{self.camera}: {self.name}")

    def failed(self, error: BaseException) -> dict[str, Any]:
        """Return the answer for an error."""
        return {**failure(error), **self.service.nothing}

    def what(self, request: PlainRequest) -> object:
        """Return a key of the work, equal for a repetition of the same call."""
        same = request.model_copy(update={"timeout": None, "epoch": None})
        return self.camera, self.service, same


@dataclass(eq=False)
class _PlainCall:
    """A running or remembered call.

    Attributes:
        what: key of the work, by which a repetition of the call is recognized.
        waiting: questions that wait for the call's answer.
        answer: the answer; None while the call runs.
    """

    what: object
    waiting: list[BusQuestion] = field(default_factory=list["BusQuestion"])
    answer: bytes | None = None


class _KnownAnswers:
    """Calls of one kind with an id, running or remembered."""

    def __init__(self) -> None:
        self._calls: dict[tuple[str, str], _PlainCall] = {}  # oldest first
        self._bytes = 0

    def of(self, request: PlainRequest) -> _PlainCall | None:
        """Return the call with a request's id."""
        return self._calls.get((request.program, str(request.id)))

    def begin(self, request: PlainRequest, call: _PlainCall) -> None:
        """Remember a running call."""
        self._calls[request.program, str(request.id)] = call

    def end(self, answer: bytes) -> None:
        """Keep a further answer, and drop the oldest beyond the bounds; running calls stay."""
        self._bytes += len(answer)
        for key in [*self._calls]:
            if (
                len(self._calls) <= MAX_ANSWERS_REMEMBERED
                and self._bytes <= MAX_ANSWER_BYTES_REMEMBERED
            ):
                return
            old = self._calls[key].answer
            if old is not None:
                self._bytes -= len(old)
                del self._calls[key]


class Plain:
    """The part of an agent for programs without smartcam.

    Args:
        agent: the agent.
        keys: keys of the fleet.
        bus: the agent's end of the bus.
        calibrations: calibrations of the agent's cameras; None if there is no folder for them.

    Attributes:
        topics: topics of the agent's cameras in JSON.
    """

    def __init__(
        self, agent: Agent, keys: Keys, bus: Bus, calibrations: CalibrationDesks | None = None
    ) -> None:
        self._agent, self._keys, self._bus = agent, keys, bus
        self._calibrations = calibrations
        self.topics = Topics(agent.name, agent.epoch, keys, bus)
        self._pulse = Pulse()
        self._declared: list[Handle] = []
        self._program = agent.next_program()
        self._numbers = 0
        # running calls by camera, and whether only operators may make them
        self._under_way: collections.Counter[tuple[str, bool]] = collections.Counter()
        self._known_answers = {operates: _KnownAnswers() for operates in (True, False)}
        self._added: dict[str, PlainRequest] = {}  # cameras added by Setup, with their requests

    def open(self) -> None:
        """Start to answer."""
        keys, answer = self._keys, self._bus.answer
        self.topics.open()
        self._pulse.open()
        self._declared = [
            answer(keys.listing("**"), self._on_listing, patient=always),
            answer(keys.service("*", "**"), self._on_service, patient=_only_looks),
            answer(keys.thesis("*"), self._on_thesis),
        ]

    def close(self) -> None:
        """Stop answering; running calls end with the agent's tasks."""
        declared, self._declared = self._declared, []
        for handle in declared:
            handle.close()
        self._pulse.close()
        self.topics.close()

    @property
    def busy(self) -> bool:
        """True while a command runs."""
        return any(operates for _, operates in self._under_way)

    # ------------------------------------------------------------------ questions

    def _on_listing(self, question: BusQuestion) -> None:
        for name, host in self._agent.hosts.items():
            key = self._keys.listing(name)
            if meets(question.key, key):
                question.reply(key, as_json(host.topics.listing()))
        question.close()

    def _on_service(self, question: BusQuestion) -> None:
        if "*" in question.key:
            self._refuse_pattern(question)
            return
        *chunks, name = self._keys.tail(question.key, "service")
        camera = "/".join(chunks)
        fields, error = request_fields(question.payload)
        service = SERVICES.get(name, UNKNOWN)
        if service is UNKNOWN:
            error = ConfigurationError(
                f"{camera}: there is no service {name!r:.80}{did_you_mean(name, SERVICES)}; there "
                f"are {', '.join(SERVICES)}"
            )
        waited = self._pulse.waited()
        self._take(question, _Order(camera, name, service, fields, error, waited))

    def _on_thesis(self, question: BusQuestion) -> None:
        if "*" in question.key:
            self._refuse_pattern(question)
            return
        (name,) = self._keys.tail(question.key, "thesis")
        fields, error = request_fields(question.payload)
        service = THESIS.get(name, UNKNOWN)
        if service is UNKNOWN:
            error = ConfigurationError(
                f"there is no service {name!r:.80}{did_you_mean(name, THESIS)}; there are "
                f"{', '.join(THESIS)}"
            )
        camera: Any = None if fields is None else fields.get("camera_name")
        if error is None and (not isinstance(camera, str) or not camera):
            error = ConfigurationError(
                f"{name}: expected camera_name, the name of a camera, got {camera!r:.80}"
            )
        if error is not None and (not isinstance(camera, str) or not camera):
            _reply(question, _Order("", name, service, fields, error).failed(error))
            return
        waited = self._pulse.waited()
        self._take(question, _Order(str(camera), name, service, fields, error, waited))

    def _refuse_pattern(self, question: BusQuestion) -> None:
        """Refuse a command to a pattern of cameras."""
        error = ConfigurationError(
            f"{question.key!r:.200}: expected a key with exactly one camera and one service in it, "
            "without *; nothing was done"
        )
        _reply(question, failure(error))

    def _take(self, question: BusQuestion, order: _Order) -> None:
        if order.camera in self._agent.hosts:
            self._begin(question, order)
            return
        try:
            check_name(order.camera)
        except ConfigurationError as error:
            _reply(question, order.failed(error))  # every agent gives the same answer
            return
        if self._is_full(question, order):
            return
        self._start(self._for_stranger(question, order), order)

    def _is_full(self, question: BusQuestion, order: _Order) -> bool:
        """Refuse a question beyond the bound of its camera, or of all unknown cameras."""
        full = self._under_way[self._place(order)] >= MAX_CONCURRENT_CALLS
        if full:
            kind = "commands" if order.operates else "questions"
            full_of = f"{MAX_CONCURRENT_CALLS} {kind} are under way"
            text = f"{order.camera}: {full_of}; {order.name} was not done"
            _reply(question, order.failed(LocalProtocolError(text)))
        return full

    def _start(self, work: Any, order: _Order) -> None:
        """Run work for a camera in a counted task."""
        place, counts = self._place(order), self._under_way
        counts[place] += 1

        def done(_: object) -> None:
            counts[place] -= 1
            if not counts[place]:
                del counts[place]

        task = self._agent.begin(work, f"smartcam.fleet.{order.camera}.{order.name}")
        task.add_done_callback(done)

    def _place(self, order: _Order) -> tuple[str, bool]:
        camera = order.camera if order.camera in self._agent.hosts else ""
        return camera, order.operates

    # ------------------------------------------------------------------ other cameras

    async def _for_stranger(self, question: BusQuestion, order: _Order) -> None:
        """Answer for an unknown camera, if no agent has it and this agent is the first one."""
        try:
            speaks = await self._speaks_for_all(order.camera)
        except BaseException:
            question.close()
            raise
        if not speaks:
            question.close()
        elif order.camera in self._agent.hosts or order.service is SETUP:
            self._begin(question, order)
        else:
            error = ConfigurationError(
                f"the fleet {self._keys.fleet} has no camera {order.camera!r}"
                f"{did_you_mean(order.camera, self._agent.hosts)}; {order.name} was not done"
            )
            _reply(question, order.failed(error))

    async def _speaks_for_all(self, camera: str) -> bool:
        """Return True if no other agent has a camera and this agent is the first by its name."""
        keys, bus = self._keys, self._bus
        having, present = await asyncio.gather(
            bus.present(keys.camera("*", camera), PRESENCE_TIMEOUT),
            bus.present(keys.agent("*"), PRESENCE_TIMEOUT),
        )
        owners = {keys.tail(key, "presence/camera")[0] for key in having} - {self._agent.name}
        agents = {keys.tail(key, "presence/agent")[0] for key in present} | {self._agent.name}
        return not owners and min(agents) == self._agent.name

    # ------------------------------------------------------------------ calls

    def _begin(self, question: BusQuestion, order: _Order) -> None:
        """Start a call, unless it is a repetition."""
        try:
            request = order.request()
            if request.epoch not in {None, str(self._agent.epoch)}:
                raise ConnectionLostError(
                    f"{order.camera}: the agent {self._agent.name} was restarted since; "
                    f"{order.name} was not done by this one"
                )
            call = None if request.id is None else self._known_call(order, request)
            if (
                call is not None
                and call.answer is None
                and len(call.waiting) >= MAX_WAITING_REPEATS
            ):
                raise LocalProtocolError(f"{order.camera}: {order.name} is under way already")
        except SmartCamError as error:
            _reply(question, order.failed(error))
            return
        if call is None:
            if not self._is_full(question, order):
                call = _PlainCall(order.what(request), [question])
                if request.id is not None:
                    self._known_answers[order.operates].begin(request, call)
                self._start(self._do(order, request, call), order)
        elif call.answer is None:
            call.waiting.append(question)
        else:
            question.reply(question.key, call.answer)
            question.close()

    def _known_call(self, order: _Order, request: PlainRequest) -> _PlainCall | None:
        known = self._known_answers[order.operates].of(request)
        if known is not None and known.what != order.what(request):
            raise LocalProtocolError(
                f"{order.camera}: id {request.id!r} was another call's; {order.name} was not done"
            )
        return known

    async def _do(self, order: _Order, request: PlainRequest, call: _PlainCall) -> None:
        """Carry out a call, and answer all its questions."""
        name = order.name
        answer: dict[str, Any] = {}
        try:
            answer = {"error": "", **await self._bounded(order, request)}
        except asyncio.CancelledError:
            error = ConnectionClosedError(
                f"{order.camera}: the agent ends; whether {name} was done is unknown"
            )
            answer = order.failed(error)
            raise
        except Exception as exc:
            if not isinstance(exc, SmartCamError):
                logger.exception("%s ! %s failed", order.camera, name)
            answer = order.failed(exc)
        finally:
            call.answer = as_json(answer)
            waiting, call.waiting = call.waiting, []
            for question in waiting:
                question.reply(question.key, call.answer)
                question.close()
            if request.id is not None:
                self._known_answers[order.operates].end(call.answer)

    async def _bounded(self, order: _Order, request: PlainRequest) -> dict[str, Any]:
        """Carry out a call within its timeout.

        Raises:
            SmartCamError: the call failed; or it did not end in time, with an unknown outcome.
        """
        service = order.service
        wanted = timeout = request.timeout or service.timeout
        if request.deadline is not None:
            timeout = min(timeout, request.deadline - time.time())
            if timeout <= 0:
                text = f"{order.camera}: {order.name} came after its deadline; it was not done"
                raise late(order.name, text)
        elif order.waited:
            timeout -= order.waited
            if timeout <= 0:
                raise late(
                    order.name,
                    f"{order.camera}: the agent was stopped for {order.waited:.1f} s, for which "
                    f"{order.name} may have waited: longer than its timeout of {wanted:g} s; it "
                    "was not done. One with a deadline is done until then",
                )
        loop = asyncio.get_running_loop()
        begun = loop.time()
        try:
            async with asyncio.timeout(timeout + CANCEL_GRACE) as limit:
                host = await self._host(order, request)
                if getattr(request, "application", 0) or getattr(request, "application_id", 0):
                    # switching there and back takes further time
                    limit.reschedule(
                        begun + timeout + CANCEL_GRACE + 2 * host.settings.switch_timeout
                    )
                try:
                    return await self._serve(order, request, host, begun + timeout)
                except BaseException:
                    await self._take_back(order.camera, request)
                    raise
        except TimeoutError as exc:
            if isinstance(exc, SmartCamError):
                raise
            raise ResponseTimeoutError(
                f"{order.camera}: {order.name} took longer than {timeout:.3g} s; whether it was "
                "done is unknown",
                waited=timeout,
            ) from exc

    async def _serve(
        self, order: _Order, request: PlainRequest, host: Host, deadline: float
    ) -> dict[str, Any]:
        service, loop = order.service, asyncio.get_running_loop()
        self._numbers += 1
        program = f"{request.program or 'a program'} without smartcam"
        gated = service.command and (service is not STOP or host.name in self._added)
        if gated:
            await host.enter(program, order.name, deadline - loop.time())
        try:
            left = max(0.0, deadline - loop.time())
            owner = Owner(self._program, self._numbers)
            with host.counted(order.name):
                work = Work(host, host.topics, request, left, owner, self._calibrations)
                answer = await service.do(work)
            if service is STOP and host.name in self._added:
                self._added.pop(host.name, None)
                await self._agent.unshare(host.name, "a program has stopped it")
        finally:
            if gated:
                host.gate.leave(program)
        return answer

    # ------------------------------------------------------------------ cameras that Setup adds

    async def _host(self, order: _Order, request: PlainRequest) -> Host:
        """Return the camera; Setup adds a camera that no agent has."""
        host = self._agent.hosts.get(order.camera)
        if host is not None:
            if isinstance(request, SetupRequest):
                await host.tried(SETUP_WAIT)
            return host
        if not isinstance(request, SetupRequest):
            raise ConnectionClosedError(f"{order.camera}: the camera was stopped meanwhile")
        settings = new_camera(request)
        await self._agent.refuse_taken(order.camera, settings)
        if order.camera in self._agent.hosts:
            return await self._host(order, request)  # another Setup was faster
        if len(self._added) >= MAX_CAMERAS_ADDED:
            raise LocalProtocolError(f"{order.camera}: Setup has added {MAX_CAMERAS_ADDED} cameras")
        self._added[order.camera] = request
        try:
            host = self._agent.share(order.camera, settings)
            await host.tried(SETUP_WAIT)
            host.require()
        except BaseException:
            await self._take_back(order.camera, request)
            raise
        return host

    async def _take_back(self, camera: str, request: PlainRequest) -> None:
        """Remove the camera that a failed Setup has added."""
        if self._added.get(camera) is request:
            del self._added[camera]
            if camera in self._agent.hosts:
                await self._agent.unshare(camera, "its Setup has failed")


def request_fields(payload: bytes) -> tuple[dict[str, Any] | None, SmartCamError | None]:
    """Return a request's fields, or its error. No bytes are an empty request."""
    if len(payload) > MAX_REQUEST_BYTES:
        text = f"a request of {len(payload)} bytes; {MAX_REQUEST_BYTES} are taken"
        return None, ConfigurationError(text)
    try:
        fields: Any = json.loads(payload, parse_constant=_no_number) if payload.strip() else {}
    except (ValueError, RecursionError) as exc:
        return None, ConfigurationError(f"the request is no JSON: {exc}")
    if not isinstance(fields, dict):
        text = f"expected a JSON object, got {type(fields).__name__}"
        return None, ConfigurationError(f"the request: {text}")
    return cast("dict[str, Any]", fields), None


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON's")


def _only_looks(key: str) -> bool:
    """Return True if a service changes nothing, so that viewers may use it, too."""
    service = SERVICES.get(key.rpartition("/")[2])
    return service is not None and not service.command


def _reply(question: BusQuestion, answer: dict[str, Any]) -> None:
    question.reply(question.key, as_json(answer))
    question.close()
