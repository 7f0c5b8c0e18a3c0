"""An emulated Cognex In-Sight camera on a real port: native mode over telnet.

::

    async with EmulatedInSight(jobs=[{"file": "7bolts.job", "cells": {"B2": 12.5}}]) as emulator:
        emulator.url    # insight://127.0.0.1:PORT

The answers, and the sources of the facts, are in ``docs/insight.md``.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from smartcam._arguments import (
    check_application_or_name,
    check_flag,
    check_integer,
    check_iterable,
    check_seconds,
    check_text,
    check_texts,
)
from smartcam.emulator._camera import SHOWN_FIELDS
from smartcam.emulator._clock import nanoseconds
from smartcam.emulator._insight.commands import InSightCommands, InSightQuirks, image_answer
from smartcam.emulator._insight.connection import MAX_SESSIONS, ROWS, WRITE_LIMIT, TelnetClient
from smartcam.emulator._insight.device import InSightDevice
from smartcam.emulator._insight.job import BUILTIN_JOBS
from smartcam.emulator._line_camera import LineCamera
from smartcam.emulator._line_codec import LineCodec
from smartcam.emulator._scenario.states import DeviceState
from smartcam.emulator._tally import Tally
from smartcam.exceptions import ConfigurationError, ResponseTimeoutError
from smartcam.models import Status
from smartcam.protocols._inside import INSIGHT, ONLINE, words
from smartcam.settings import validated

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from typing import Self

    import numpy as np
    from numpy.typing import NDArray

    from smartcam.emulator._client_link import ClientLink
    from smartcam.emulator._insight.job import Job
    from smartcam.emulator._line_camera import LineClient
    from smartcam.emulator._line_codec import LineServer, SaidLine
    from smartcam.emulator._scenario.scenario import Scenario
    from smartcam.protocols import Protocol

MAX_NEXT_CODES = 1000
"""Largest number of codes that may wait to replace the answers of commands."""


class _NextCode(NamedTuple):
    """An answer to a future command, which replaces the command's own."""

    code: int
    command: str | None


class EmulatedInSight(LineCamera):
    """An In-Sight camera made of software, on a real port.

    Several clients may be logged in at a time: that a camera has several users at once is
    published, their largest number is not.

    Args:
        jobs: jobs stored on the camera: :class:`Job` or mappings of its fields.
        users: password of each user; it is published that a new camera has ``admin`` without one.
        model: name of the camera model, in the first line that the camera sends.
        active: file, or id, of the job that is loaded at first; default the first of the jobs;
            without jobs, an empty one that was never saved.
        online: whether the camera is online at first.
        image: the 8 bit grey image that the camera sees; default a pattern.
        evaluations: answers to ``EV``: expression to the text that is sent; others fail.
        info: lines of the answer to ``GI``, instead of the emulator's own.
        quirks: choices where real cameras are unknown: :class:`InSightQuirks` or a mapping.
        options: options of :class:`~smartcam.emulator.LineCamera`.

    Attributes:
        device: the camera itself, to be read only; to make it act, use the emulator's
            methods.
        refuse_login: True: every user is refused.
        silent: True: commands are carried out, but not answered.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    protocol: Protocol = INSIGHT
    device: InSightDevice
    states: ClassVar[frozenset[DeviceState]] = LineCamera.states | {
        DeviceState.RUNNING,
        DeviceState.STOPPED,
    }
    max_links: int = MAX_SESSIONS
    write_limit: int = WRITE_LIMIT

    def __init__(
        self,
        jobs: Iterable[Job | Mapping[str, Any]] = (),
        *,
        users: Mapping[str, str] | None = None,
        model: str = "8502P",
        active: str | int | None = None,
        online: bool = False,
        image: Any = None,
        evaluations: Mapping[str, str] | None = None,
        info: Mapping[str, str] | None = None,
        quirks: InSightQuirks | Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        owner = "emulator"
        online = check_flag(online, "online", owner)
        model = check_text(model, "model", owner, least=1, most=100)
        if active is not None:
            active = check_application_or_name(active, "active", owner)
        jobs = check_iterable(jobs, "jobs", "a list of jobs", owner)
        users, evaluations, info = (
            None if given is None else check_texts(given, option, owner)
            for option, given in (("users", users), ("evaluations", evaluations), ("info", info))
        )
        self.device = InSightDevice(jobs, active=active, online=online, image=image)
        self.refuse_login: bool = False
        self.silent: bool = False
        self._users = {"admin": ""} if users is None else dict(users)
        self._model = model
        self._commands = InSightCommands(
            self.device,
            evaluations=evaluations,
            info=info,
            quirks=validated(InSightQuirks, {} if quirks is None else quirks, "quirks"),
        )
        self._next_codes: deque[_NextCode] = deque()
        self._commands_received: Tally[str] = Tally()
        self._clock_offset = 0  # clock minus device's time, nanoseconds; the latter may stand still
        self._was_online = online
        super().__init__(**options)
        self.device.action_context = self.step

    @classmethod
    def from_scenario(cls, plan: Scenario, **given: Any) -> Self:
        """Return a camera of a scenario; without jobs, with the built-in ones."""
        options = {"jobs": BUILTIN_JOBS, **plan.options}
        return super().from_scenario(plan.model_copy(update={"options": options}), **given)

    @classmethod
    def state_options(cls, active: int | None, *, running: bool) -> dict[str, Any]:
        """Return the options for a camera whose job is active, and online, from the start."""
        return {"active": active, "online": running}

    def make_codec(self) -> LineCodec:
        """Return the codec of its lines."""
        return LineCodec(
            next(iter(INSIGHT.dialects)),
            ROWS,
            line_end=words.LINE_END,
            client_line_end=words.COMMAND_ENDS,
            max_line=words.MAX_LINE_BYTES,
            encoding=words.ENCODING,
        )

    # ------------------------------------------------------------------ properties

    @property
    def application_ids(self) -> list[int]:
        """Ids of its jobs; jobs without an id are left out."""
        return [job.id for job in self.device.jobs.values() if job.id is not None]

    def shown(self) -> dict[str, Any]:
        """Return the state of the camera that its page shows."""
        device, job = self.device, self.device.job
        jobs = [stored_job for stored_job in device.jobs.values() if stored_job.id is not None]
        return {
            **super().shown(),
            "mode": device.mode,
            "status": ONLINE if device.online else Status(0),
            "active_application": None if job is None else job.id,
            "running": device.online,
            "processing": device.busy,
            "next_number": device.runs + 1,
            "run_ends": "TriggerAnswer",
            "applications": [
                {
                    **dict.fromkeys(SHOWN_FIELDS),
                    "id": stored_job.id,
                    "name": stored_job.file,
                    "rate": stored_job.rate,
                    "load_time": stored_job.load_time,
                    "processing_time": stored_job.processing_time,
                }
                for stored_job in jobs
            ],
            "cells": dict(device.cells),
            "quirks": self.quirks,
            "quirks_chosen": self.quirks.model_dump(exclude_defaults=True),
        }

    @property
    def online(self) -> bool:
        """True while the camera is online."""
        return self.device.online

    @property
    def active(self) -> str | None:
        """File of the active job, None for one that was never saved."""
        return None if self.device.job is None else self.device.job.file

    @property
    def quirks(self) -> InSightQuirks:
        """The camera's quirks."""
        return self._commands.quirks

    @property
    def sessions(self) -> list[str]:
        """Address and port of the clients that are logged in, the oldest session first."""
        return [client.peer for client in self._clients_by_number() if client.logged_in]

    @property
    def links(self) -> list[str]:
        """Address and port of all clients that are connected."""
        return [client.peer for client in self._clients_by_number()]

    @classmethod
    def image_answer(cls, image: NDArray[np.uint8]) -> bytes:
        """Return the answer to ``RI`` for a picture, (H, W)."""
        return image_answer(image)

    # ------------------------------------------------------------------ the operator

    def set_online(self, online: bool) -> None:
        """Switch the camera online, or hold it offline, as an operator; then ``SO1`` gets -5."""
        self.device.set_online(check_flag(online, "online", "emulator"))

    def set_image(self, image: NDArray[np.uint8]) -> None:
        """Let the camera see another image.

        Raises:
            ConfigurationError: the image is no 8 bit grey image.
        """
        self.device.image = image

    def trigger(self) -> bool:
        """Trigger by the input; return False if the camera does not accept it."""
        return self.device.trigger()

    def load(self, job: str | int) -> None:
        """Load a job by hand, at once and in either mode; a running run ends without a result.

        Args:
            job: file name or id of the job.

        Raises:
            ConfigurationError: there is no such job, or another one is being loaded.
        """
        self.device.load(check_application_or_name(job, "job", "emulator"))

    def answer_next(self, code: int, *, command: str | None = None) -> None:
        """Answer a command with a status code instead of carrying it out.

        The codes of several calls are used in the order of the calls.

        Args:
            code: the code.
            command: the two letters of the command; default the next command of any kind.

        Raises:
            ConfigurationError: 1000 answers wait to be used already.
        """
        code = check_integer(code, "code", -(1 << 31), (1 << 31) - 1, "emulator")
        if command is not None:
            command = check_text(command, "command", "emulator", least=1, most=100)
        if len(self._next_codes) >= MAX_NEXT_CODES:
            raise ConfigurationError(f"{MAX_NEXT_CODES} codes wait already")
        self._next_codes.append(_NextCode(code, None if command is None else command.upper()))

    def drop_connections(self) -> None:
        """End every connection at once, like a broken network. Running events continue."""
        for client in self._clients_by_number():
            client.close("dropped")

    async def wait_heard(self, command: str, *, count: int = 1, timeout: float = 5.0) -> None:
        """Wait until clients have sent a command ``count`` times since the beginning.

        On return, the camera has begun to carry the command out. The timeout runs in real time,
        whatever the emulator's clock is.

        Args:
            command: the two letters of the command.
            count: number of times, including those before this call.
            timeout: seconds.

        Raises:
            ResponseTimeoutError: the command did not come in time.

        Cancellation: safe.
        """
        mnemonic = check_text(command, "command", "wait_heard", least=1, most=100).upper()
        count = check_integer(count, "count", 0, owner="wait_heard")
        timeout = check_seconds(timeout, "timeout", "wait_heard")
        try:
            await self._commands_received.wait(mnemonic, count, timeout)
        except TimeoutError as exc:
            raise ResponseTimeoutError(
                f"the emulator received {self._commands_received[mnemonic]} of {count} {mnemonic} "
                f"in {timeout} s",
                waited=timeout,
            ) from exc

    # ------------------------------------------------------------------ life

    async def stop(self) -> None:
        """Close the port and every connection; the camera stands still. Do nothing if stopped.

        Cancellation: everything is closed nevertheless.
        """
        with self.step():
            pass  # events that were due happen
        await super().stop()

    # ------------------------------------------------------------------ clients

    def make_client(self, link: ClientLink, server: LineServer) -> TelnetClient:
        """Return a new client."""
        taken = {client.number for client in self._clients_by_number()}
        number = next(number for number in range(MAX_SESSIONS + 1) if number not in taken)
        return TelnetClient(self, link, server, number)

    def greet(self, client: LineClient) -> None:
        """Send the greeting and ask for the user."""
        if isinstance(client, TelnetClient):
            client.say_bytes(self.greeting(client.number))

    def hear(self, client: LineClient, line: str) -> None:
        """Carry out a line."""
        if isinstance(client, TelnetClient):
            client.handle_line(line)

    def serves(self, link: ClientLink) -> bool:
        """Return True if the client on the link is logged in."""
        client = self._clients.get(link)
        return isinstance(client, TelnetClient) and client.logged_in

    def say(self, link: ClientLink, message: SaidLine) -> None:
        """Send a line to a link, unless the camera is silent."""
        if not self.silent:
            super().say(link, message)

    def greeting(self, number: int) -> bytes:
        """Return a new connection's greeting; two spaces before the model (clients, derived)."""
        text = f"{words.WELCOME}(tm)  {self._model} Session {number}"
        return text.encode(words.ENCODING) + words.LINE_END + words.USER_PROMPT

    def admits(self, user: str, password: str) -> bool:
        """Return True if a login is right; user names are case sensitive (manual, published)."""
        known = self._users.get(user)
        return known is not None and known == password and not self.refuse_login

    def execute(self, client: TelnetClient, line: str) -> None:
        """Carry out a line of a logged-in client."""
        mnemonic = line[:2].upper()
        code = self._take_next_code(mnemonic)
        if code is not None:
            client.respond(str(code).encode("ascii") + words.LINE_END)
        else:
            self._commands.execute(line, client.respond)
        self._commands_received.add(mnemonic if mnemonic in words.COMMANDS else "")

    # ------------------------------------------------------------------ inside

    def _take_next_code(self, mnemonic: str) -> int | None:
        for index, answer in enumerate(self._next_codes):
            if answer.command in {None, mnemonic}:
                del self._next_codes[index]
                return answer.code
        return None

    def _clients_by_number(self) -> list[TelnetClient]:
        clients = [client for client in self._clients.values() if isinstance(client, TelnetClient)]
        return sorted(clients, key=lambda client: client.number)

    def _after_start(self) -> None:
        self._clock_offset = nanoseconds(self.clock.now) - self.device.now

    def _advance_device(self, now: float) -> None:
        self.device.advance_to(nanoseconds(now) - self._clock_offset)
        super()._advance_device(now)

    def _finish_step(self) -> None:
        if self.device.online != self._was_online:
            self._was_online = self.device.online
            self._timeline.note_entered(
                DeviceState.RUNNING if self._was_online else DeviceState.STOPPED
            )
        super()._finish_step()

    def _next_call_at(self) -> int | None:
        event_at, call_at = self.device.next_event_at, super()._next_call_at()
        device_event_at = None if event_at is None else event_at + self._clock_offset
        return min((time for time in (device_event_at, call_at) if time is not None), default=None)
