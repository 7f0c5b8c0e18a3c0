"""Serve programs that do not use smartcam: list an agent's cameras, and carry out services.

An agent answers every question, except questions about another agent's cameras. Each service runs
in a task of the agent. The task is cancelled after the service's timeout, or when the agent ends.
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
from smartcam.fleet._agent.client import Owner
from smartcam.fleet._agent.pulse import Pulse
from smartcam.fleet._bus.address import check_name
from smartcam.fleet._bus.bus import always
from smartcam.fleet._bus.errors import late_call_error
from smartcam.fleet._bus.keys import patterns_overlap
from smartcam.fleet._json.calibrations import CALIBRATIONS
from smartcam.fleet._json.services import SERVICES, UNKNOWN, JsonRequest, Service, Work
from smartcam.fleet._json.thesis import SETUP, STOP, new_camera
from smartcam.fleet._json.thesis import THESIS as CAMERA_SERVICES
from smartcam.fleet._json.topics import Topics, as_json
from smartcam.fleet._program.reading import error_fields
from smartcam.settings import validated

if TYPE_CHECKING:
    from smartcam.calibration._inside import CalibrationsByCamera
    from smartcam.fleet._agent.agent import Agent
    from smartcam.fleet._agent.shared_camera import SharedCamera
    from smartcam.fleet._bus.bus import Bus, BusQuestion, Handle
    from smartcam.fleet._bus.keys import Keys

logger: logging.Logger = logging.getLogger("smartcam.fleet")

THESIS = {**CAMERA_SERVICES, **CALIBRATIONS}
"""The services of the interface that the thesis on smart cameras defines, by name."""

MAX_REQUEST_BYTES = 1 << 18
"""Largest number of bytes of a request."""

MAX_CONCURRENT_CALLS = 256
"""Largest number of running commands of one camera, and largest number of its running questions."""

MAX_WAITING_REPEATS = 16
"""Largest number of repetitions of a call that wait for its answer."""

MAX_ANSWERS_REMEMBERED, MAX_ANSWER_BYTES_REMEMBERED = 4096, 1 << 24
"""Largest number of remembered answers to commands that had an id, and largest number of bytes of
these answers. Answers to questions are bounded in the same way, but separately, so that a program
that only asks cannot displace the answers to commands."""

MAX_CAMERAS_ADDED = 100
"""Largest number of cameras that Setup adds."""

CANCEL_GRACE = 0.5
"""Seconds after a service's timeout when the service's task is cancelled."""

SETUP_WAIT = 600.0
"""Largest number of seconds for which Setup waits for a camera; the timeout in its request is
usually shorter."""

PRESENCE_TIMEOUT = 2.0
"""Seconds for the answer to a question about presences on the bus."""


class _ServiceQuery(NamedTuple):
    """A decoded question for a service: which camera, which service, which fields.

    Attributes:
        camera: name of the camera of the service.
        name: name of the service.
        service: the service.
        fields: fields of the request; None if the request cannot be read.
        error: error of the request; None if there is none.
        max_wait: longest time that the request may have waited before it was received, seconds.
    """

    camera: str
    name: str
    service: Service
    fields: dict[str, Any] | None
    error: SmartCamError | None
    max_wait: float = 0.0

    @property
    def is_for_operators(self) -> bool:
        """True if only operators may use the service; False if viewers may, too."""
        return self.service.is_command or self.name not in SERVICES

    def request(self) -> Any:
        """Return the request.

        Raises:
            SmartCamError: the fields are not a valid request.
        """
        if self.error is not None:
            raise self.error
        fields = {key: value for key, value in (self.fields or {}).items() if value is not None}
        return validated(self.service.request, fields, f"{self.camera}: {self.name}")

    def error_answer(self, error: BaseException) -> dict[str, Any]:
        """Return the answer for an error."""
        return {**error_fields(error), **self.service.empty_fields}

    def call_key(self, request: JsonRequest) -> object:
        """Return a key of the call, which is equal for a repetition of the same call."""
        without_limits = request.model_copy(update={"timeout": None, "epoch": None})
        return self.camera, self.service, without_limits


@dataclass(eq=False)
class _JsonCall:
    """A running or remembered call.

    Attributes:
        key: key by which a repetition of the call is recognized.
        waiting: questions that wait for the call's answer.
        answer: the answer; None while the call runs.
    """

    key: object
    waiting: list[BusQuestion] = field(default_factory=list["BusQuestion"])
    answer: bytes | None = None


class _KnownAnswers:
    """Running and remembered calls that have an id: either the commands, or the questions."""

    def __init__(self) -> None:
        self._calls: dict[tuple[str, str], _JsonCall] = {}  # oldest first
        self._bytes = 0

    def find_call(self, request: JsonRequest) -> _JsonCall | None:
        """Return the call with a request's id."""
        return self._calls.get((request.program, str(request.id)))

    def add_call(self, request: JsonRequest, call: _JsonCall) -> None:
        """Remember a running call."""
        self._calls[request.program, str(request.id)] = call

    def count_answer(self, answer: bytes) -> None:
        """Count a further answer, and drop the oldest answers beyond the bounds."""
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


class JsonServices:
    """The services of an agent for programs that do not use smartcam, in JSON.

    Args:
        agent: the agent.
        keys: keys of the fleet.
        bus: the agent's connection to the bus.
        calibrations: calibrations of the agent's cameras; None if there is no folder for them.

    Attributes:
        topics: topics of the agent's cameras in JSON.
    """

    def __init__(
        self, agent: Agent, keys: Keys, bus: Bus, calibrations: CalibrationsByCamera | None = None
    ) -> None:
        self._agent, self._keys, self._bus = agent, keys, bus
        self._calibrations = calibrations
        self.topics = Topics(agent.name, agent.epoch, keys, bus)
        self._pulse = Pulse()
        self._handles: list[Handle] = []
        self._program = agent.new_program_number()
        self._last_call_number = 0
        # numbers of running calls, by camera and by whether they are for operators
        self._running_counts: collections.Counter[tuple[str, bool]] = collections.Counter()
        self._known_answers = {
            is_for_operators: _KnownAnswers() for is_for_operators in (True, False)
        }
        self._added_cameras: dict[
            str, JsonRequest
        ] = {}  # requests of the Setups that added cameras

    def open(self) -> None:
        """Start to answer."""
        keys, answer = self._keys, self._bus.answer
        self.topics.open()
        self._pulse.open()
        self._handles = [
            answer(keys.listing("**"), self._on_listing, low_priority=always),
            answer(keys.service("*", "**"), self._on_service, low_priority=_is_read_only),
            answer(keys.thesis("*"), self._on_thesis),
        ]

    def close(self) -> None:
        """Stop answering; running calls end with the agent's tasks."""
        handles, self._handles = self._handles, []
        for handle in handles:
            handle.close()
        self._pulse.close()
        self.topics.close()

    @property
    def busy(self) -> bool:
        """True while a command runs."""
        return any(is_for_operators for _, is_for_operators in self._running_counts)

    # ------------------------------------------------------------------ questions

    def _on_listing(self, question: BusQuestion) -> None:
        for name, camera in self._agent.shared_cameras.items():
            key = self._keys.listing(name)
            if patterns_overlap(question.key, key):
                question.reply(key, as_json(camera.topics.listing()))
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
        max_wait = self._pulse.max_wait()
        self._accept_question(
            question, _ServiceQuery(camera, name, service, fields, error, max_wait)
        )

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
            _reply(question, _ServiceQuery("", name, service, fields, error).error_answer(error))
            return
        max_wait = self._pulse.max_wait()
        self._accept_question(
            question, _ServiceQuery(str(camera), name, service, fields, error, max_wait)
        )

    def _refuse_pattern(self, question: BusQuestion) -> None:
        """Refuse a question to a pattern of cameras."""
        error = ConfigurationError(
            f"{question.key!r:.200}: expected a key with exactly one camera and one service in it, "
            "without *; nothing was done"
        )
        _reply(question, error_fields(error))

    def _accept_question(self, question: BusQuestion, query: _ServiceQuery) -> None:
        if query.camera in self._agent.shared_cameras:
            self._start_call(question, query)
            return
        try:
            check_name(query.camera)
        except ConfigurationError as error:
            _reply(question, query.error_answer(error))  # every agent gives the same answer
            return
        if self._refuse_if_full(question, query):
            return
        self._start_task(self._answer_unknown_camera(question, query), query)

    def _refuse_if_full(self, question: BusQuestion, query: _ServiceQuery) -> bool:
        """Refuse a question if too many are running for its camera; return whether it was refused.

        All unknown cameras are counted together.
        """
        is_full = self._running_counts[self._count_key(query)] >= MAX_CONCURRENT_CALLS
        if is_full:
            kind = "commands" if query.is_for_operators else "questions"
            running = f"{MAX_CONCURRENT_CALLS} {kind} are under way"
            text = f"{query.camera}: {running}; {query.name} was not done"
            _reply(question, query.error_answer(LocalProtocolError(text)))
        return is_full

    def _start_task(self, work: Any, query: _ServiceQuery) -> None:
        """Run work for a camera in a counted task."""
        key, counts = self._count_key(query), self._running_counts
        counts[key] += 1

        def on_done(_: object) -> None:
            counts[key] -= 1
            if not counts[key]:
                del counts[key]

        task = self._agent.start_task(work, f"smartcam.fleet.{query.camera}.{query.name}")
        task.add_done_callback(on_done)

    def _count_key(self, query: _ServiceQuery) -> tuple[str, bool]:
        camera = query.camera if query.camera in self._agent.shared_cameras else ""
        return camera, query.is_for_operators

    # ------------------------------------------------------------------ other cameras

    async def _answer_unknown_camera(self, question: BusQuestion, query: _ServiceQuery) -> None:
        """Answer a question for a camera that no agent has, if this agent's name sorts first."""
        try:
            answers = await self._must_answer(query.camera)
        except BaseException:
            question.close()
            raise
        if not answers:
            question.close()
        elif query.camera in self._agent.shared_cameras or query.service is SETUP:
            self._start_call(question, query)
        else:
            error = ConfigurationError(
                f"the fleet {self._keys.fleet} has no camera {query.camera!r}"
                f"{did_you_mean(query.camera, self._agent.shared_cameras)}; {query.name} was not "
                "done"
            )
            _reply(question, query.error_answer(error))

    async def _must_answer(self, camera: str) -> bool:
        """Return True if no other agent has the camera, and this agent's name sorts first."""
        keys, bus = self._keys, self._bus
        having, present = await asyncio.gather(
            bus.present_keys(keys.camera("*", camera), PRESENCE_TIMEOUT),
            bus.present_keys(keys.agent("*"), PRESENCE_TIMEOUT),
        )
        owners = {keys.tail(key, "presence/camera")[0] for key in having} - {self._agent.name}
        agents = {keys.tail(key, "presence/agent")[0] for key in present} | {self._agent.name}
        return not owners and min(agents) == self._agent.name

    # ------------------------------------------------------------------ calls

    def _start_call(self, question: BusQuestion, query: _ServiceQuery) -> None:
        """Start a call, unless it is a repetition."""
        try:
            request = query.request()
            if request.epoch not in {None, str(self._agent.epoch)}:
                raise ConnectionLostError(
                    f"{query.camera}: the agent {self._agent.name} was restarted since; "
                    f"{query.name} was not done by this one"
                )
            call = None if request.id is None else self._known_call(query, request)
            if (
                call is not None
                and call.answer is None
                and len(call.waiting) >= MAX_WAITING_REPEATS
            ):
                raise LocalProtocolError(f"{query.camera}: {query.name} is under way already")
        except SmartCamError as error:
            _reply(question, query.error_answer(error))
            return
        if call is None:
            if not self._refuse_if_full(question, query):
                call = _JsonCall(query.call_key(request), [question])
                if request.id is not None:
                    self._known_answers[query.is_for_operators].add_call(request, call)
                self._start_task(self._carry_out(query, request, call), query)
        elif call.answer is None:
            call.waiting.append(question)
        else:
            question.reply(question.key, call.answer)
            question.close()

    def _known_call(self, query: _ServiceQuery, request: JsonRequest) -> _JsonCall | None:
        known = self._known_answers[query.is_for_operators].find_call(request)
        if known is not None and known.key != query.call_key(request):
            raise LocalProtocolError(
                f"{query.camera}: id {request.id!r} was another call's; {query.name} was not done"
            )
        return known

    async def _carry_out(self, query: _ServiceQuery, request: JsonRequest, call: _JsonCall) -> None:
        """Carry out a call, and answer all its questions."""
        name = query.name
        answer: dict[str, Any] = {}
        try:
            answer = {"error": "", **await self._carry_out_in_time(query, request)}
        except asyncio.CancelledError:
            error = ConnectionClosedError(
                f"{query.camera}: the agent ends; whether {name} was done is unknown"
            )
            answer = query.error_answer(error)
            raise
        except Exception as exc:
            if not isinstance(exc, SmartCamError):
                logger.exception("%s ! %s failed", query.camera, name)
            answer = query.error_answer(exc)
        finally:
            call.answer = as_json(answer)
            waiting, call.waiting = call.waiting, []
            for question in waiting:
                question.reply(question.key, call.answer)
                question.close()
            if request.id is not None:
                self._known_answers[query.is_for_operators].count_answer(call.answer)

    async def _carry_out_in_time(
        self, query: _ServiceQuery, request: JsonRequest
    ) -> dict[str, Any]:
        """Carry out a call within its timeout.

        Raises:
            SmartCamError: the call failed, or did not end in time; then its outcome is unknown.
        """
        service = query.service
        full_timeout = timeout = request.timeout or service.timeout
        if request.deadline is not None:
            timeout = min(timeout, request.deadline - time.time())
            if timeout <= 0:
                text = f"{query.camera}: {query.name} came after its deadline; it was not done"
                raise late_call_error(query.name, text)
        elif query.max_wait:
            timeout -= query.max_wait
            if timeout <= 0:
                raise late_call_error(
                    query.name,
                    f"{query.camera}: the agent's process hung for {query.max_wait:.1f} s, so "
                    f"{query.name} may be older than its timeout of {full_timeout:g} s; it was not "
                    "done. A request with a deadline is done until then",
                )
        loop = asyncio.get_running_loop()
        started_at = loop.time()
        try:
            async with asyncio.timeout(timeout + CANCEL_GRACE) as limit:
                camera = await self._get_camera(query, request)
                if getattr(request, "application", 0) or getattr(request, "application_id", 0):
                    # two switches of the application take further time
                    limit.reschedule(
                        started_at + timeout + CANCEL_GRACE + 2 * camera.settings.switch_timeout
                    )
                try:
                    return await self._serve(query, request, camera, started_at + timeout)
                except BaseException:
                    await self._remove_added_camera(query.camera, request)
                    raise
        except TimeoutError as exc:
            if isinstance(exc, SmartCamError):
                raise
            raise ResponseTimeoutError(
                f"{query.camera}: {query.name} took longer than {timeout:.3g} s; whether it was "
                "done is unknown",
                waited=timeout,
            ) from exc

    async def _serve(
        self, query: _ServiceQuery, request: JsonRequest, camera: SharedCamera, deadline: float
    ) -> dict[str, Any]:
        service, loop = query.service, asyncio.get_running_loop()
        self._last_call_number += 1
        program = f"{request.program or 'a program'} (not a smartcam client)"
        needs_gate = service.is_command and (
            service is not STOP or camera.name in self._added_cameras
        )
        if needs_gate:
            await camera.enter_gate(program, query.name, deadline - loop.time())
        try:
            remaining = max(0.0, deadline - loop.time())
            owner = Owner(self._program, self._last_call_number)
            with camera.counting_trigger(query.name):
                work = Work(camera, camera.topics, request, remaining, owner, self._calibrations)
                answer = await service.carry_out(work)
            if service is STOP and camera.name in self._added_cameras:
                self._added_cameras.pop(camera.name, None)
                await self._agent.unshare(camera.name, "a program has stopped it")
        finally:
            if needs_gate:
                camera.gate.leave(program)
        return answer

    # ------------------------------------------------------------------ cameras that Setup adds

    async def _get_camera(self, query: _ServiceQuery, request: JsonRequest) -> SharedCamera:
        """Return the camera; Setup adds a camera that no agent has."""
        camera = self._agent.shared_cameras.get(query.camera)
        if camera is not None:
            if isinstance(request, SetupRequest):
                await camera.wait_first_attempt(SETUP_WAIT)
            return camera
        if not isinstance(request, SetupRequest):
            raise ConnectionClosedError(f"{query.camera}: the camera was stopped meanwhile")
        settings = new_camera(request)
        await self._agent.check_address_free(query.camera, settings)
        if query.camera in self._agent.shared_cameras:
            return await self._get_camera(query, request)  # another Setup was faster
        if len(self._added_cameras) >= MAX_CAMERAS_ADDED:
            raise LocalProtocolError(f"{query.camera}: Setup has added {MAX_CAMERAS_ADDED} cameras")
        self._added_cameras[query.camera] = request
        try:
            camera = self._agent.share(query.camera, settings)
            await camera.wait_first_attempt(SETUP_WAIT)
            camera.require_client()
        except BaseException:
            await self._remove_added_camera(query.camera, request)
            raise
        return camera

    async def _remove_added_camera(self, camera: str, request: JsonRequest) -> None:
        """Remove the camera that a failed Setup has added."""
        if self._added_cameras.get(camera) is request:
            del self._added_cameras[camera]
            if camera in self._agent.shared_cameras:
                await self._agent.unshare(camera, "its Setup has failed")


def request_fields(payload: bytes) -> tuple[dict[str, Any] | None, SmartCamError | None]:
    """Return a request's fields, or its error. An empty payload is a request without fields."""
    if len(payload) > MAX_REQUEST_BYTES:
        text = f"a request of {len(payload)} bytes; at most {MAX_REQUEST_BYTES} are accepted"
        return None, ConfigurationError(text)
    try:
        fields: Any = (
            json.loads(payload, parse_constant=_refuse_constant) if payload.strip() else {}
        )
    except (ValueError, RecursionError) as exc:
        return None, ConfigurationError(f"the request is no JSON: {exc}")
    if not isinstance(fields, dict):
        text = f"expected a JSON object, got {type(fields).__name__}"
        return None, ConfigurationError(f"the request: {text}")
    return cast("dict[str, Any]", fields), None


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON's")


def _is_read_only(key: str) -> bool:
    """Return True if the key is of a service that changes nothing, which viewers may use, too."""
    service = SERVICES.get(key.rpartition("/")[2])
    return service is not None and not service.is_command


def _reply(question: BusQuestion, answer: dict[str, Any]) -> None:
    question.reply(question.key, as_json(answer))
    question.close()
