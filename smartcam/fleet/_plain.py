"""What an agent does for programs without smartcam: it lists its cameras, and serves them.

Every question is answered, but those about cameras that another agent has: these that one answers.
A service is done in a task of the agent's, which ends with its deadline and with the agent.
"""

from __future__ import annotations

import asyncio
import collections
import json
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import (
    ConfigurationError,
    ConnectionClosedError,
    ConnectionLostError,
    LocalProtocolError,
    ResponseTimeoutError,
    SmartCamError,
)
from smartcam.fleet._address import check_name
from smartcam.fleet._keys import meets
from smartcam.fleet._reading import failure
from smartcam.fleet._services import SERVICES, UNKNOWN, PlainRequest, Service, Work
from smartcam.fleet._shared import Owner
from smartcam.fleet._thesis import SETUP, STOP, THESIS, ThesisSetup
from smartcam.fleet._topics import Topics, as_json
from smartcam.settings import validated

if TYPE_CHECKING:
    from smartcam.fleet._agent import Agent
    from smartcam.fleet._bus import Bus, BusQuestion, Handle
    from smartcam.fleet._host import Host
    from smartcam.fleet._keys import Keys

logger: logging.Logger = logging.getLogger("smartcam.fleet")

MOST_REQUEST = 1 << 18
"""Bytes of a request."""

MOST_CALLS = 256
"""Calls to one camera that may be under way at a time."""

MOST_REPEATS = 16
"""Questions that wait for the answer of one call."""

MOST_KNOWN, MOST_KNOWN_BYTES = 4096, 1 << 24
"""Answers of calls with an id that are remembered, and their bytes; the oldest are forgotten."""

MOST_ADDED = 100
"""Cameras that Setup adds."""

GRACE = 0.5
"""Seconds beyond a service's timeout after which it is given up, whatever it does."""

FIRST_TRY = 600.0
"""Seconds that Setup waits for a camera; its timeout is shorter."""

LOOK = 2.0
"""Seconds for asking the bus who is there."""


class _Order(NamedTuple):
    """What a question wants.

    Attributes:
        camera: whose service it is.
        name: of the service.
        service: the service.
        fields: of the request; None where they cannot be read.
        error: what is wrong with it.
    """

    camera: str
    name: str
    service: Service
    fields: dict[str, Any] | None
    error: SmartCamError | None

    def request(self) -> Any:
        """Return the request.

        Raises:
            SmartCamError: it is none.
        """
        if self.error is not None:
            raise self.error
        given = {key: value for key, value in (self.fields or {}).items() if value is not None}
        return validated(self.service.request, given, f"{self.camera}: {self.name}")

    def failed(self, error: BaseException) -> dict[str, Any]:
        """Return the answer for an error."""
        return {**failure(error), **self.service.nothing}

    def what(self, request: PlainRequest) -> object:
        """Return what is to be done, to know the same call again."""
        same = request.model_copy(update={"timeout": None, "epoch": None})
        return self.camera, self.service, same


@dataclass(eq=False)
class _PlainCall:
    """A call, under way or done.

    Attributes:
        what: what it does, to know whether another is the same.
        waiting: questions that want its answer.
        answer: the answer, None before.
    """

    what: object
    waiting: list[BusQuestion] = field(default_factory=list["BusQuestion"])
    answer: bytes | None = None


class Plain:
    """The side of an agent that programs without smartcam use.

    Args:
        agent: the agent.
        keys: of the fleet.
        bus: the agent's end of it.

    Attributes:
        topics: what is said of the agent's cameras in JSON.
    """

    def __init__(self, agent: Agent, keys: Keys, bus: Bus) -> None:
        self._agent, self._keys, self._bus = agent, keys, bus
        self.topics = Topics(agent.name, agent.epoch, keys, bus)
        self._declared: list[Handle] = []
        self._program = agent.next_program()
        self._numbers = 0
        self._under_way: collections.Counter[str] = collections.Counter()
        self._known: collections.OrderedDict[tuple[str, str], _PlainCall] = (
            collections.OrderedDict()
        )
        self._known_bytes = 0
        self._added: set[str] = set()

    def open(self) -> None:
        """Answer from now on."""
        keys, answer = self._keys, self._bus.answer
        self.topics.open()
        self._declared = [
            answer(keys.listing("**"), self._on_listing),
            answer(keys.service("*", "**"), self._on_service),
            answer(keys.thesis("*"), self._on_thesis),
        ]

    def close(self) -> None:
        """Answer no more; calls under way end with the agent's tasks."""
        declared, self._declared = self._declared, []
        for handle in declared:
            handle.close()
        self.topics.close()

    @property
    def busy(self) -> bool:
        """Whether a call is under way."""
        return bool(self._under_way)

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
        fields, error = _fields(question.payload)
        service = SERVICES.get(name, UNKNOWN)
        if service is UNKNOWN:
            error = ConfigurationError(
                f"{camera}: there is no service {name!r:.80}{did_you_mean(name, SERVICES)}; there "
                f"are {', '.join(SERVICES)}"
            )
        self._take(question, _Order(camera, name, service, fields, error))

    def _on_thesis(self, question: BusQuestion) -> None:
        if "*" in question.key:
            self._refuse_pattern(question)
            return
        (name,) = self._keys.tail(question.key, "thesis")
        fields, error = _fields(question.payload)
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
            _say(question, _Order("", name, service, fields, error).failed(error))
            return
        self._take(question, _Order(str(camera), name, service, fields, error))

    def _refuse_pattern(self, question: BusQuestion) -> None:
        """A command for whoever it may concern is none."""
        error = ConfigurationError(
            f"{question.key!r:.200}: expected a key with exactly one camera and one service in it, "
            "without *; nothing was done"
        )
        _say(question, failure(error))

    def _take(self, question: BusQuestion, order: _Order) -> None:
        if order.camera in self._agent.hosts:
            self._begin(question, order)
            return
        try:
            check_name(order.camera)
        except ConfigurationError as error:
            _say(question, order.failed(error))  # every agent says the same
            return
        if self._is_full(question, order):
            return
        self._start(self._for_stranger(question, order), order)

    def _is_full(self, question: BusQuestion, order: _Order) -> bool:
        """Refuse what is too much for one camera, or for all together that are not here."""
        full = self._under_way[self._place(order)] >= MOST_CALLS
        if full:
            text = f"{order.camera}: {MOST_CALLS} calls are under way; {order.name} was not done"
            _say(question, order.failed(LocalProtocolError(text)))
        return full

    def _start(self, work: Any, order: _Order) -> None:
        """Do something for a camera in a task; counted."""
        place, counts = self._place(order), self._under_way
        counts[place] += 1

        def done(_: object) -> None:
            counts[place] -= 1
            if not counts[place]:
                del counts[place]

        task = self._agent.begin(work, f"smartcam.fleet.{order.camera}.{order.name}")
        task.add_done_callback(done)

    def _place(self, order: _Order) -> str:
        return order.camera if order.camera in self._agent.hosts else ""

    # ------------------------------------------------------------------ other cameras

    async def _for_stranger(self, question: BusQuestion, order: _Order) -> None:
        """Answer for a camera that is not here; if nobody has it, one agent does so."""
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
            _say(question, order.failed(error))

    async def _speaks_for_all(self, camera: str) -> bool:
        """Whether no other agent has a camera, and this one is the first of all by its name."""
        keys, bus = self._keys, self._bus
        having, there = await asyncio.gather(
            bus.present(keys.camera("*", camera), LOOK), bus.present(keys.agent("*"), LOOK)
        )
        owners = {keys.tail(key, "presence/camera")[0] for key in having} - {self._agent.name}
        agents = {keys.tail(key, "presence/agent")[0] for key in there} | {self._agent.name}
        return not owners and min(agents) == self._agent.name

    # ------------------------------------------------------------------ calls

    def _begin(self, question: BusQuestion, order: _Order) -> None:
        """Have a call done, unless it is one that was done before or is under way."""
        try:
            request = order.request()
            if request.epoch not in {None, str(self._agent.epoch)}:
                raise ConnectionLostError(
                    f"{order.camera}: the agent {self._agent.name} was restarted since; "
                    f"{order.name} was not done by this one"
                )
            call = None if request.id is None else self._known_call(order, request)
            if call is not None and call.answer is None and len(call.waiting) >= MOST_REPEATS:
                raise LocalProtocolError(f"{order.camera}: {order.name} is under way already")
        except SmartCamError as error:
            _say(question, order.failed(error))
            return
        if call is None:
            if not self._is_full(question, order):
                call = _PlainCall(order.what(request), [question])
                if request.id is not None:
                    self._remember(request, call)
                self._start(self._do(order, request, call), order)
        elif call.answer is None:
            call.waiting.append(question)
        else:
            question.reply(question.key, call.answer)
            question.close()

    def _known_call(self, order: _Order, request: PlainRequest) -> _PlainCall | None:
        known = self._known.get((request.program, str(request.id)))
        if known is not None and known.what != order.what(request):
            raise LocalProtocolError(
                f"{order.camera}: id {request.id!r} was another call's; {order.name} was not done"
            )
        return known

    def _remember(self, request: PlainRequest, call: _PlainCall) -> None:
        self._known[request.program, str(request.id)] = call

    def _forget_old(self) -> None:
        """Keep no more answers than are to be; calls under way stay."""
        known = self._known
        for key in [*known]:
            if len(known) <= MOST_KNOWN and self._known_bytes <= MOST_KNOWN_BYTES:
                return
            answer = known[key].answer
            if answer is not None:
                self._known_bytes -= len(answer)
                del known[key]

    async def _do(self, order: _Order, request: PlainRequest, call: _PlainCall) -> None:
        """Do a call, and answer all who asked for it."""
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
                self._known_bytes += len(call.answer)
                self._forget_old()

    async def _bounded(self, order: _Order, request: PlainRequest) -> dict[str, Any]:
        """Do a call within its time.

        Raises:
            SmartCamError: as it ends; or nobody knows how, since it did not in time.
        """
        service = order.service
        timeout = request.timeout or service.timeout
        loop = asyncio.get_running_loop()
        begun = loop.time()
        try:
            async with asyncio.timeout(timeout + GRACE) as limit:
                host = await self._host(order, request)
                if getattr(request, "application", 0) or getattr(request, "application_id", 0):
                    # a switch there and one back have times of their own
                    limit.reschedule(begun + timeout + GRACE + 2 * host.settings.switch_timeout)
                return await self._serve(order, request, host, begun + timeout)
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
                answer = await service.do(Work(host, host.topics, request, left, owner))
            if service is STOP and host.name in self._added:
                self._added.discard(host.name)
                await self._agent.unshare(host.name)
        finally:
            if gated:
                host.gate.leave(program)
        return answer

    # ------------------------------------------------------------------ cameras that Setup adds

    async def _host(self, order: _Order, request: PlainRequest) -> Host:
        """Return the camera; Setup adds one that nobody has."""
        host = self._agent.hosts.get(order.camera)
        if host is not None:
            if isinstance(request, ThesisSetup):
                await host.tried(FIRST_TRY)
            return host
        if not isinstance(request, ThesisSetup):
            raise ConnectionClosedError(f"{order.camera}: the camera was stopped meanwhile")
        if len(self._added) >= MOST_ADDED:
            raise LocalProtocolError(f"{order.camera}: Setup has added {MOST_ADDED} cameras")
        settings = request.settings()
        self._added.add(order.camera)
        try:
            host = self._agent.share(order.camera, settings)
            await host.tried(FIRST_TRY)
            host.require()
        except BaseException:
            self._added.discard(order.camera)
            if order.camera in self._agent.hosts:
                await self._agent.unshare(order.camera)
            raise
        return host


def _fields(payload: bytes) -> tuple[dict[str, Any] | None, SmartCamError | None]:
    """Return a request's fields, or what is wrong with it. Nothing is an empty request."""
    if len(payload) > MOST_REQUEST:
        text = f"a request of {len(payload)} bytes; {MOST_REQUEST} are taken"
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


def _say(question: BusQuestion, answer: dict[str, Any]) -> None:
    question.reply(question.key, as_json(answer))
    question.close()
