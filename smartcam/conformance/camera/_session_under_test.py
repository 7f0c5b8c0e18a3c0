"""The camera under test: sessions, states that a check needs, and the restored state."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._raw_client import MAX_TRAIL, EndedError, RawClient
from smartcam.conformance.camera._verdicts import Differs, NotObserved
from smartcam.conformance.camera._wire import RawDialect
from smartcam.doctor._inside import trials as probe_trials
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId, load_protocol
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.conformance.camera._options import ConformanceOptions
    from smartcam.conformance.camera._wire import ReceivedFrame
    from smartcam.protocols import FramedDialect
    from smartcam.settings import Address

T = TypeVar("T")

SESSION_TRIES = 3
"""Number of links tried for a session: the first attempt after an old session may fail (T 3.1.4,
published)."""

DETECTION_TIMEOUT = 10.0
"""Seconds for finding out the dialect."""

RESTORE_TRIES = 2
"""Number of sessions tried for restoring the state from before."""


class StateBefore(NamedTuple):
    """The camera's state that is restored at the end."""

    application: int  # id of the active one
    running: bool  # whether the camera is in run mode


class CameraUnderTest:
    """One camera and the facts learned about it so far.

    Raises:
        ConfigurationError: the address cannot work, or is no BVS camera's.
    """

    def __init__(self, options: ConformanceOptions) -> None:
        self.options: ConformanceOptions = options
        self.before: StateBefore | None = None  # state to restore; None until the first session
        self.gone: str = ""  # reason why the camera is gone, "" while it is there
        self.left: str = ""  # state that could not be restored; "" if everything was
        # messages on the wire since the last forget_trail()
        self.trail: deque[str] = deque(maxlen=MAX_TRAIL)
        # undocumented frames of the camera, as texts, each kind once
        self.flaws: dict[str, str] = {}
        self.measured: dict[str, float] = {}  # times in seconds, by their names
        self._address = parse_address(options.url)
        if self._address.protocol != "bvs":
            raise ConfigurationError(
                f"{options.url!r} is not the address of a BVS camera: bvs://HOST"
            )
        self._wire: RawDialect | None = None
        self._learned: dict[str, Any] = {}
        self._allow = options.allow
        self._dirty = False

    # ------------------------------------------------------------------ properties

    @property
    def transport(self) -> str:
        """Transport of the frames: ``tcp`` or ``udp``."""
        return "udp" if self._address.scheme.endswith("+udp") else "tcp"

    @property
    def address(self) -> Address:
        """Address of the camera; the dialect is pinned once it is known."""
        if self._wire is None:
            return self._address
        dialect = self._wire.dialect
        return self._address._replace(dialect=dialect.name, quirks=dialect.quirks)

    @property
    def wire(self) -> RawDialect:
        """The dialect; it is found out if the address does not name it.

        Raises:
            Differs: no dialect is answered.
        """
        if self._wire is None:
            self._wire = RawDialect(self._detect())
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
            spoken = self.once("dialect", lambda: asyncio.run(_probe(address)))
            if isinstance(spoken, str):
                raise Differs("an answer to Connect in one of the dialects", spoken)
            address = spoken
        dialect = load_protocol("bvs").dialects[cast("str", address.dialect)]
        return cast("FramedDialect", dialect).with_quirks(address.quirks)

    def learn_quirk(self, name: str, *, on: bool) -> None:
        """Note whether the camera deviates from its dialect in this way."""
        dialect = self.wire.dialect
        names = {*dialect.quirks, name} if on else {*dialect.quirks} - {name}
        plain = cast("FramedDialect", load_protocol("bvs").dialects[dialect.name])
        self._wire = RawDialect(plain.with_quirks(names))

    @property
    def patience(self) -> float:
        """Seconds to wait for an answer that may not come, if no other answer can show that."""
        return 4 * self.options.quiet

    def once(self, name: str, observe: Callable[[], T]) -> T:
        """Make an observation once; return its result again, or raise its exception again."""
        if name not in self._learned:
            try:
                self._learned[name] = observe()
            except (Differs, NotObserved, EndedError) as exc:
                self._learned[name] = exc
        learned = self._learned[name]
        if isinstance(learned, Exception):
            raise learned
        return cast("T", learned)

    def forget_trail(self) -> None:
        """Begin a new record of messages on the wire."""
        self.trail.clear()

    # ------------------------------------------------------------------ links

    @contextlib.contextmanager
    def link(self) -> Iterator[RawClient]:
        """Open a link to the camera, without a session.

        Raises:
            NotObserved: there is no connection.
        """
        try:
            client = self.open()
        except OSError as exc:
            where = f"{self._address.host}:{self._address.port}"
            raise NotObserved(f"there is no connection to {where}: {exc}") from exc
        try:
            with client:
                yield client
        finally:
            for frame in client.received:
                self._learn_code(frame)
                flaw = self.wire.flaw(frame)
                if flaw is not None:
                    self.flaws.setdefault(flaw, self.wire.spell(frame))

    def open(self) -> RawClient:
        """Open a link to the camera; the caller closes it.

        Raises:
            OSError: there is no connection.
        """
        return RawClient(
            self.wire,
            (self._address.host, self._address.port),
            self.transport == "tcp",
            self.options.timeout,
            self.options.quiet,
            self.trail,
            self._will_change,
        )

    def _will_change(self) -> None:
        self._dirty = True

    @contextlib.contextmanager
    def session(self) -> Iterator[RawClient]:
        """Open a session; a smart camera's first status has been received.

        Raises:
            NotObserved: the camera gives no session.
        """
        if self.gone:
            raise NotObserved(f"the camera is gone: {self.gone}")
        with contextlib.ExitStack() as stack:
            client = self._connect(stack)
            if self.before is None:
                self._remember(client)
            yield client

    def _connect(self, stack: contextlib.ExitStack) -> RawClient:
        why = ""
        for number in range(SESSION_TRIES):
            attempt = contextlib.ExitStack()
            try:
                client = attempt.enter_context(self.link())
                if number:
                    client.send(m.Disconnect())
                self.greet(client)
            except (NotObserved, Differs, EndedError) as exc:
                attempt.close()
                why = str(exc)
            else:
                stack.enter_context(attempt.pop_all())
                return client
        self.gone = why
        raise NotObserved(f"there is no session: {why}")

    def greet(self, client: RawClient) -> ReceivedFrame:
        """Connect on a link and return the answer; also wait for a status that comes unasked.

        Raises:
            Differs: the camera does not answer.
            EndedError: the camera ends the link.
        """
        answer = client.answer(m.Connect())
        self._learn_code(answer)
        client.wire = self.wire
        if not self.wire.is_bid:
            client.until(MessageId.STATUS, self.options.timeout, "a status after Connect", mark=0)
        return answer

    def _learn_code(self, frame: ReceivedFrame) -> None:
        """Learn whether ``b16`` answers have a code, from the length of the answer to Connect."""
        if self.dialect == "b16" and frame.message_id == MessageId.CONNECT:
            self.learn_quirk("code", on=len(frame.body) == 4)

    # ------------------------------------------------------------------ its state

    def _remember(self, client: RawClient) -> None:
        began = time.monotonic()
        application = self.active(client)
        self.measured["query"] = time.monotonic() - began
        self.before = StateBefore(application, self.running(client))

    def active(self, client: RawClient) -> int:
        """Return the active application's id.

        Raises:
            Differs: the camera does not answer with it.
        """
        answer = client.answer(m.Query())
        numbers = self.wire.numbers(answer.body)
        at = 1 if self.wire.dialect.coded else 0
        if len(numbers) <= at:
            raise Differs("the active application's id", self.wire.spell(answer))
        return numbers[at]

    def running(self, client: RawClient) -> bool:
        """Return True if the camera is in run mode; a BVS ID always is."""
        return self.wire.is_bid or bool(client.look() & self.wire.bits.running)

    @property
    def application(self) -> int:
        """Id of the application to trigger."""
        if self.options.application is not None:
            return self.options.application
        if self.before is None:
            raise NotObserved("there was no session yet")
        return self.before.application

    def require(self, needs: Allow) -> None:
        """Check that an action is allowed.

        Raises:
            NotObserved: the option does not allow this.
        """
        missing = needs & ~self._allow
        if missing:
            raise NotObserved(f"--camera-allow does not have {' and '.join(missing.names)}")

    def stop(self, client: RawClient) -> None:
        """Make sure that the camera is not in run mode.

        Raises:
            NotObserved: Stop is not allowed.
            Differs: the camera does not stop.
        """
        bits = self.wire.bits
        if self.wire.is_bid or not client.look() & bits.running:
            return
        self.require(Allow.RUN)
        client.send(m.Stop())
        client.wait_status(
            lambda word: not word & bits.running, self.options.timeout, "a status without Running"
        )

    def start(self, client: RawClient) -> None:
        """Make sure that the camera is in run mode; raises as :meth:`stop`."""
        bits = self.wire.bits
        if self.wire.is_bid or client.look() & bits.running:
            return
        self.require(Allow.RUN)
        client.send(m.Start())
        client.wait_status(
            lambda word: word & bits.running, self.options.timeout, "a status with Running"
        )

    def load(self, client: RawClient, application: int) -> list[ReceivedFrame]:
        """Load an application; return the frames from the request to its end.

        Raises:
            NotObserved: the switch is not allowed, or the camera refuses it.
            Differs: the switch is not answered, or leads to another application.
        """
        if self.active(client) == application:
            return []
        self.require(Allow.SWITCH)
        self.stop(client)
        mark = len(client.received)
        answer = client.answer(
            m.SwitchApplication(application=application), within=self.options.switch_timeout
        )
        code, now = (*self.wire.numbers(answer.body), -1, -1)[:2]
        if code:
            raise NotObserved(
                f"the camera does not load application {application}: {self.wire.spell(answer)}"
            )
        if now != application:
            raise Differs(f"application {application} in the answer", self.wire.spell(answer))
        bits = self.wire.bits
        client.wait_status(
            lambda word: word & bits.ready if self.wire.is_bid else not word & bits.busy,
            self.options.switch_timeout,
            "a status that is not busy",
        )
        return client.received[mark:]

    def ready(self, client: RawClient) -> None:
        """Make sure that the application is loaded and waits for a trigger.

        Raises:
            NotObserved: a switch is not allowed, or the application needs no trigger.
            Differs: the camera does not do it.
        """
        self.load(client, self.application)
        self.start(client)
        self.once_waiting(client)

    def once_waiting(self, client: RawClient) -> None:
        """Wait until the camera waits for a trigger; raises as :meth:`ready`."""
        if self._learned.get("runs free") == self.application:
            raise NotObserved(f"application {self.application} runs without triggers")
        waiting = self.wire.bits.waiting
        try:
            client.wait_status(
                lambda word: word & waiting,
                self.options.timeout,
                "a status with Waiting for Trigger",
            )
        except Differs as exc:
            self._learned["runs free"] = self.application
            raise NotObserved(
                f"application {self.application} did not wait for a trigger within "
                f"{self.options.timeout:g} s: {exc.came}"
            ) from exc

    # ------------------------------------------------------------------ afterwards

    def restore(self, *, again: bool = False) -> None:
        """Restore the active application and whether it runs; never raises.

        Bounded: two sessions, in which each wait has its own limit. A state that cannot be restored
        is named in :attr:`left`. ``again``: try it even if it failed before.
        """
        before, why = self.before, ""
        if not self._dirty or before is None or (self.left and not again):
            return
        gone, self.gone = self.gone, ""
        for _ in range(RESTORE_TRIES):
            try:
                with self.session() as client:
                    self._put_back(client, before)
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

    def _put_back(self, client: RawClient, before: StateBefore) -> None:
        allowed = self._allow
        self._allow |= Allow.RUN | Allow.SWITCH  # our own changes may be undone
        try:
            self.load(client, before.application)
            (self.start if before.running else self.stop)(client)
        finally:
            self._allow = allowed


async def _probe(address: Address) -> Address | str:
    """Return the address with its dialect, or the outcome of each try as text."""
    tried: list[str] = []
    outcome: Address | str | None = None
    async with contextlib.aclosing(probe_trials(address, timeout=DETECTION_TIMEOUT)) as trials:
        async for trial in trials:
            if trial.address.scheme != address.scheme:
                break
            if trial.answer is not None:
                outcome = parse_address(trial.answer.url)
                break
            tried.append(str(trial))
    return outcome or "; ".join(tried)
