"""The camera under test: sessions with it, the states a check needs, and what is put back."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

from smartcam._client.handshake import load_protocol
from smartcam.conformance.camera.options import Allow
from smartcam.conformance.camera.raw_client import MAX_TRAIL, EndedError, Line
from smartcam.conformance.camera.results import Differs, NotObserved
from smartcam.conformance.camera.wire import Wire
from smartcam.doctor import probing
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import MessageId
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.conformance.camera.options import Plan
    from smartcam.conformance.camera.wire import Heard
    from smartcam.protocols.framed.dialect import FramedDialect
    from smartcam.settings import Address

__all__ = ["SESSION_TRIES", "Bench", "State"]

T = TypeVar("T")

SESSION_TRIES = 3
"""Links tried for a session: the first attempt after an old session may fail (T 3.1.4,
published)."""

DETECTION_TIMEOUT = 10.0
"""Seconds in which the dialect is found out."""

RESTORE_TRIES = 2
"""Sessions in which the state of before is put back."""


class State(NamedTuple):
    """What is put back.

    Attributes:
        application: id of the active one.
        running: in run mode.
    """

    application: int
    running: bool


class Bench:
    """One camera and what was learned of it so far.

    Args:
        plan: what is asked for.

    Raises:
        ConfigurationError: the address cannot work, or is no BVS camera's.

    Attributes:
        plan: as given.
        before: what is put back, None until the first session.
        gone: why there is no camera any more, "" while there is one.
        left: what could not be put back, "" where everything was.
        trail: what went over the wire since the last :meth:`forget_trail`.
        flaws: frames of the camera that are not documented, as texts, each kind once.
        measured: times in seconds, by what was measured.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan: Plan = plan
        self.before: State | None = None
        self.gone: str = ""
        self.left: str = ""
        self.trail: deque[str] = deque(maxlen=MAX_TRAIL)
        self.flaws: dict[str, str] = {}
        self.measured: dict[str, float] = {}
        self._address = parse_address(plan.url)
        if self._address.protocol != "bvs":
            raise ConfigurationError(f"{plan.url!r} is not the address of a BVS camera: bvs://HOST")
        self._wire: Wire | None = None
        self._learned: dict[str, Any] = {}
        self._allow = plan.allow
        self._dirty = False

    # ------------------------------------------------------------------ what it is

    @property
    def transport(self) -> str:
        """What carries the frames: ``tcp`` or ``udp``."""
        return "udp" if self._address.scheme.endswith("+udp") else "tcp"

    @property
    def address(self) -> Address:
        """Where the camera is; the dialect is pinned once it is known."""
        if self._wire is None:
            return self._address
        dialect = self._wire.dialect
        return self._address._replace(dialect=dialect.name, quirks=dialect.quirks)

    @property
    def wire(self) -> Wire:
        """The dialect; it is found out where the address does not name it.

        Raises:
            Differs: no dialect is answered.
        """
        if self._wire is None:
            self._wire = Wire(self._detect())
        return self._wire

    @property
    def dialect(self) -> str:
        """The dialect's name; raises as :attr:`wire`."""
        return self.wire.dialect.name

    @property
    def known_dialect(self) -> str:
        """The dialect's name, "" while it is not known."""
        return self._address.dialect or "" if self._wire is None else self._wire.dialect.name

    def _detect(self) -> FramedDialect:
        address = self._address
        if address.dialect is None:
            found = self.once("dialect", lambda: asyncio.run(_probe(address)))
            if isinstance(found, str):
                raise Differs("an answer to Connect in one of the dialects", found)
            address = found
        dialect = load_protocol("bvs").dialects[cast("str", address.dialect)]
        return cast("FramedDialect", dialect).with_quirks(address.quirks)

    def learn_quirk(self, name: str, *, on: bool) -> None:
        """The camera deviates from its dialect in this way, or does not."""
        dialect = self.wire.dialect
        names = {*dialect.quirks, name} if on else {*dialect.quirks} - {name}
        plain = cast("FramedDialect", load_protocol("bvs").dialects[dialect.name])
        self._wire = Wire(plain.with_quirks(names))

    @property
    def patience(self) -> float:
        """Seconds that an answer gets which may not come, where no other answer can tell."""
        return 4 * self.plan.quiet

    def once(self, name: str, observe: Callable[[], T]) -> T:
        """Return what an observation gave, or raise what it raised: it is made once."""
        if name not in self._learned:
            try:
                self._learned[name] = observe()
            except (Differs, NotObserved, EndedError) as exc:
                self._learned[name] = exc
        found = self._learned[name]
        if isinstance(found, Exception):
            raise found
        return cast("T", found)

    def forget_trail(self) -> None:
        """Begin anew to write down what goes over the wire."""
        self.trail.clear()

    # ------------------------------------------------------------------ ways to it

    @contextlib.contextmanager
    def link(self) -> Iterator[Line]:
        """Open a way to the camera, without a session.

        Raises:
            NotObserved: there is no connection.
        """
        try:
            line = self.open()
        except OSError as exc:
            where = f"{self._address.host}:{self._address.port}"
            raise NotObserved(f"there is no connection to {where}: {exc}") from exc
        try:
            with line:
                yield line
        finally:
            for heard in line.heard:
                self._learn_code(heard)
                flaw = self.wire.flaw(heard)
                if flaw is not None:
                    self.flaws.setdefault(flaw, self.wire.spell(heard))

    def open(self) -> Line:
        """Open a way to the camera; whoever does it closes it.

        Raises:
            OSError: there is no connection.
        """
        line = Line(
            self.wire,
            (self._address.host, self._address.port),
            self.transport,
            timeout=self.plan.timeout,
            quiet=self.plan.quiet,
            trail=self.trail,
        )
        line.on_change = self._will_change
        return line

    def _will_change(self) -> None:
        self._dirty = True

    @contextlib.contextmanager
    def session(self) -> Iterator[Line]:
        """Open a session; a smart camera's first status has come.

        Raises:
            NotObserved: there is none.
        """
        if self.gone:
            raise NotObserved(f"the camera is gone: {self.gone}")
        with contextlib.ExitStack() as stack:
            line = self._connect(stack)
            if self.before is None:
                self._remember(line)
            yield line

    def _connect(self, stack: contextlib.ExitStack) -> Line:
        why = ""
        for number in range(SESSION_TRIES):
            attempt = contextlib.ExitStack()
            try:
                line = attempt.enter_context(self.link())
                if number:
                    line.say(m.Disconnect())
                self.greet(line)
            except (NotObserved, Differs, EndedError) as exc:
                attempt.close()
                why = str(exc)
            else:
                stack.enter_context(attempt.pop_all())
                return line
        self.gone = why
        raise NotObserved(f"there is no session: {why}")

    def greet(self, line: Line) -> Heard:
        """Connect on a link and return the answer; a status has come where one comes by itself.

        Raises:
            Differs: the camera does not answer.
            EndedError: it ends the link.
        """
        answer = line.answer(m.Connect())
        self._learn_code(answer)
        line.wire = self.wire
        if not self.wire.is_bid:
            line.until(
                lambda heard: heard.message_id == MessageId.STATUS,
                self.plan.timeout,
                "a status after Connect",
                mark=0,
            )
        return answer

    def _learn_code(self, heard: Heard) -> None:
        """In ``b16`` the length of the answer to Connect tells whether answers have a code."""
        if self.dialect == "b16" and heard.message_id == MessageId.CONNECT:
            self.learn_quirk("code", on=len(heard.body) == 4)

    # ------------------------------------------------------------------ its state

    def _remember(self, line: Line) -> None:
        began = time.monotonic()
        application = self.active(line)
        self.measured["query"] = time.monotonic() - began
        self.before = State(application, self.running(line))

    def active(self, line: Line) -> int:
        """Return the active application's id.

        Raises:
            Differs: the camera does not tell it.
        """
        answer = line.answer(m.Query())
        numbers = self.wire.numbers(answer.body)
        at = 1 if self.wire.dialect.coded else 0
        if len(numbers) <= at:
            raise Differs("the active application's id", self.wire.spell(answer))
        return numbers[at]

    def running(self, line: Line) -> bool:
        """Return whether the camera is in run mode; a BVS ID always is."""
        return self.wire.is_bid or bool(line.look() & self.wire.bits.running)

    @property
    def application(self) -> int:
        """Id of the application that may be triggered."""
        if self.plan.application is not None:
            return self.plan.application
        if self.before is None:
            raise NotObserved("there was no session yet")
        return self.before.application

    def require(self, needs: Allow) -> None:
        """See that something is allowed.

        Raises:
            NotObserved: it is not.
        """
        missing = needs & ~self._allow
        if missing:
            raise NotObserved(f"--camera-allow does not have {' and '.join(missing.names)}")

    def stop(self, line: Line) -> None:
        """Have the camera out of run mode.

        Raises:
            NotObserved: that is not allowed.
            Differs: it does not stop.
        """
        bits = self.wire.bits
        if self.wire.is_bid or not line.look() & bits.running:
            return
        self.require(Allow.RUN)
        line.say(m.Stop())
        line.wait_status(
            lambda word: not word & bits.running, self.plan.timeout, "a status without Running"
        )

    def start(self, line: Line) -> None:
        """Have the camera in run mode; raises as :meth:`stop`."""
        bits = self.wire.bits
        if self.wire.is_bid or line.look() & bits.running:
            return
        self.require(Allow.RUN)
        line.say(m.Start())
        line.wait_status(
            lambda word: word & bits.running, self.plan.timeout, "a status with Running"
        )

    def load(self, line: Line, application: int) -> list[Heard]:
        """Have an application loaded; return what came from the request to its end.

        Raises:
            NotObserved: that is not allowed, or the camera refuses it.
            Differs: it is not answered, or the application is another one then.
        """
        if self.active(line) == application:
            return []
        self.require(Allow.SWITCH)
        self.stop(line)
        mark = len(line.heard)
        answer = line.answer(
            m.SwitchApplication(application=application), within=self.plan.switch_timeout
        )
        code, now = (*self.wire.numbers(answer.body), -1, -1)[:2]
        if code:
            raise NotObserved(
                f"the camera does not load application {application}: {self.wire.spell(answer)}"
            )
        if now != application:
            raise Differs(f"application {application} in the answer", self.wire.spell(answer))
        bits = self.wire.bits
        line.wait_status(
            lambda word: word & bits.ready if self.wire.is_bid else not word & bits.busy,
            self.plan.switch_timeout,
            "a status that is not busy",
        )
        return line.heard[mark:]

    def ready(self, line: Line) -> None:
        """Have the application loaded and waiting for a trigger.

        Raises:
            NotObserved: that is not allowed, or the application needs no trigger.
            Differs: the camera does not do it.
        """
        self.load(line, self.application)
        self.start(line)
        self.once_waiting(line)

    def once_waiting(self, line: Line) -> None:
        """Wait until the camera waits for a trigger; raises as :meth:`ready`."""
        if self._learned.get("runs free") == self.application:
            raise NotObserved(f"application {self.application} runs without triggers")
        waiting = self.wire.bits.waiting
        try:
            line.wait_status(
                lambda word: word & waiting,
                self.plan.timeout,
                "a status with Waiting for Trigger",
            )
        except Differs as exc:
            self._learned["runs free"] = self.application
            raise NotObserved(
                f"application {self.application} did not wait for a trigger within "
                f"{self.plan.timeout:g} s: {exc.came}"
            ) from exc

    # ------------------------------------------------------------------ afterwards

    def restore(self, *, again: bool = False) -> None:
        """Put back which application is active and whether it runs; never raises.

        Bounded: two sessions, each wait in them has its own limit. What cannot be put back stands
        in :attr:`left`.

        Args:
            again: try it also where it could not be done before.
        """
        before, why = self.before, ""
        if not self._dirty or before is None or (self.left and not again):
            return
        gone, self.gone = self.gone, ""
        for _ in range(RESTORE_TRIES):
            try:
                with self.session() as line:
                    self._put_back(line, before)
            except (NotObserved, Differs, EndedError) as exc:
                why = str(exc)
                if self.gone:
                    break
            else:
                self._dirty = False
                self.left = ""
                return
        self.gone = self.gone or gone
        run = "running" if before.running else "stopped"
        self.left = f"application {before.application}, {run}, could not be put back: {why}"

    def _put_back(self, line: Line, before: State) -> None:
        allowed = self._allow
        self._allow |= Allow.RUN | Allow.SWITCH  # what we have changed may be changed back
        try:
            self.load(line, before.application)
            (self.start if before.running else self.stop)(line)
        finally:
            self._allow = allowed


async def _probe(address: Address) -> Address | str:
    """Return the address with its dialect, or what came of each try."""
    tried: list[str] = []
    found: Address | str | None = None
    async with contextlib.aclosing(probing.trials(address, timeout=DETECTION_TIMEOUT)) as trials:
        async for trial in trials:
            if trial.address.scheme != address.scheme:
                break
            if trial.answer is not None:
                found = parse_address(trial.answer.url)
                break
            tried.append(str(trial))
    return found or "; ".join(tried)
