"""The camera under test: opens sessions, brings the camera into states, restores its state."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._raw_client import MAX_LOG_LINES, LinkClosedError, RawClient
from smartcam.conformance.camera._verdicts import Differs, NotObserved
from smartcam.conformance.camera._wire import RawDialect
from smartcam.doctor._inside import try_ways
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

SESSION_ATTEMPTS = 3
"""Number of links tried for a session: the first attempt after an old session may fail (T 3.1.4,
published)."""

DETECTION_TIMEOUT = 10.0
"""Seconds for finding out the dialect."""

RESTORE_ATTEMPTS = 2
"""Number of sessions tried for restoring the state from before."""


class StateBefore(NamedTuple):
    """The camera's state that is restored at the end."""

    application: int  # id of the active one
    running: bool  # True if the camera is in run mode


class CameraUnderTest:
    """One camera and the facts observed so far.

    Raises:
        ConfigurationError: the address cannot work, or is not the address of a BVS camera.
    """

    def __init__(self, options: ConformanceOptions) -> None:
        self.options: ConformanceOptions = options
        self.state_before: StateBefore | None = (
            None  # state to restore; None until the first session
        )
        self.gone_reason: str = ""  # reason why the camera is gone, "" while it answers
        self.not_restored: str = ""  # state that could not be restored; "" if everything was
        # messages on the wire since the last clear_message_log()
        self.message_log: deque[str] = deque(maxlen=MAX_LOG_LINES)
        # undocumented frames of the camera, as texts, each kind once
        self.flaws: dict[str, str] = {}
        self.measured_times: dict[str, float] = {}  # times in seconds, by their names
        self._address = parse_address(options.url)
        if self._address.protocol != "bvs":
            raise ConfigurationError(
                f"{options.url!r} is not the address of a BVS camera: bvs://HOST"
            )
        self._codec: RawDialect | None = None
        self._observations: dict[str, Any] = {}
        self._allow = options.allow
        self._state_changed = False

    # ------------------------------------------------------------------ properties

    @property
    def transport(self) -> str:
        """Transport of the frames: ``tcp`` or ``udp``."""
        return "udp" if self._address.scheme.endswith("+udp") else "tcp"

    @property
    def address(self) -> Address:
        """Address of the camera, with the dialect once it is known."""
        if self._codec is None:
            return self._address
        dialect = self._codec.dialect
        return self._address._replace(dialect=dialect.name, quirks=dialect.quirks)

    @property
    def codec(self) -> RawDialect:
        """The dialect; it is found out if the address does not name it.

        Raises:
            Differs: no dialect is answered.
        """
        if self._codec is None:
            self._codec = RawDialect(self._detect())
        return self._codec

    @property
    def dialect(self) -> str:
        """The dialect's name; raises as :attr:`codec`."""
        return self.codec.dialect.name

    @property
    def known_dialect(self) -> str:
        """The dialect's name, "" while it is not known."""
        return self._address.dialect or "" if self._codec is None else self._codec.dialect.name

    def _detect(self) -> FramedDialect:
        address = self._address
        if address.dialect is None:
            detected = self.observe_once("dialect", lambda: asyncio.run(_probe(address)))
            if isinstance(detected, str):
                raise Differs("an answer to Connect in one of the dialects", detected)
            address = detected
        dialect = load_protocol("bvs").dialects[cast("str", address.dialect)]
        return cast("FramedDialect", dialect).with_quirks(address.quirks)

    def learn_quirk(self, name: str, *, is_present: bool) -> None:
        """Add a quirk to the camera's dialect, or remove it."""
        dialect = self.codec.dialect
        names = {*dialect.quirks, name} if is_present else {*dialect.quirks} - {name}
        plain = cast("FramedDialect", load_protocol("bvs").dialects[dialect.name])
        self._codec = RawDialect(plain.with_quirks(names))

    @property
    def silence_timeout(self) -> float:
        """Seconds to wait for an answer that may not come, where no round trip can show that."""
        return 4 * self.options.silence

    def observe_once(self, name: str, observe: Callable[[], T]) -> T:
        """Make an observation in the first call; later, return its result or raise its error."""
        if name not in self._observations:
            try:
                self._observations[name] = observe()
            except (Differs, NotObserved, LinkClosedError) as exc:
                self._observations[name] = exc
        observation = self._observations[name]
        if isinstance(observation, Exception):
            raise observation
        return cast("T", observation)

    def clear_message_log(self) -> None:
        """Forget the messages of earlier checks."""
        self.message_log.clear()

    # ------------------------------------------------------------------ links

    @contextlib.contextmanager
    def link(self) -> Iterator[RawClient]:
        """Open a link to the camera, without a session.

        Raises:
            NotObserved: there is no connection.
        """
        try:
            client = self.open_link()
        except OSError as exc:
            address_text = f"{self._address.host}:{self._address.port}"
            raise NotObserved(f"there is no connection to {address_text}: {exc}") from exc
        try:
            with client:
                yield client
        finally:
            for frame in client.received:
                self._learn_code(frame)
                flaw = self.codec.find_flaw(frame)
                if flaw is not None:
                    self.flaws.setdefault(flaw, self.codec.describe(frame))

    def open_link(self) -> RawClient:
        """Open a link to the camera; the caller closes it.

        Raises:
            OSError: there is no connection.
        """
        return RawClient(
            self.codec,
            (self._address.host, self._address.port),
            self.transport == "tcp",
            self.options.timeout,
            self.options.silence,
            self.message_log,
            self._note_state_change,
        )

    def _note_state_change(self) -> None:
        self._state_changed = True

    @contextlib.contextmanager
    def session(self) -> Iterator[RawClient]:
        """Open a session; from a smart camera, also receive the first status.

        Raises:
            NotObserved: the camera gives no session.
        """
        if self.gone_reason:
            raise NotObserved(f"the camera is gone: {self.gone_reason}")
        with contextlib.ExitStack() as stack:
            client = self._open_session(stack)
            if self.state_before is None:
                self._save_state(client)
            yield client

    def _open_session(self, stack: contextlib.ExitStack) -> RawClient:
        reason = ""
        for index in range(SESSION_ATTEMPTS):
            attempt = contextlib.ExitStack()
            try:
                client = attempt.enter_context(self.link())
                if index:
                    client.send(m.Disconnect())
                self.start_session(client)
            except (NotObserved, Differs, LinkClosedError) as exc:
                attempt.close()
                reason = str(exc)
            else:
                stack.enter_context(attempt.pop_all())
                return client
        self.gone_reason = reason
        raise NotObserved(f"there is no session: {reason}")

    def start_session(self, client: RawClient) -> ReceivedFrame:
        """Send Connect and return its answer; from a smart camera, also wait for a status.

        Raises:
            Differs: the camera does not answer.
            LinkClosedError: the camera ends the link.
        """
        answer = client.ask(m.Connect())
        self._learn_code(answer)
        client.codec = self.codec
        if not self.codec.is_bid:
            client.wait_for_frame(
                MessageId.STATUS, self.options.timeout, "a status after Connect", start_index=0
            )
        return answer

    def _learn_code(self, frame: ReceivedFrame) -> None:
        """Learn whether ``b16`` answers have a code, from the length of the answer to Connect."""
        if self.dialect == "b16" and frame.message_id == MessageId.CONNECT:
            self.learn_quirk("code", is_present=len(frame.body) == 4)

    # ------------------------------------------------------------------ its state

    def _save_state(self, client: RawClient) -> None:
        asked_at = time.monotonic()
        application = self.active_application(client)
        self.measured_times["query"] = time.monotonic() - asked_at
        self.state_before = StateBefore(application, self.is_running(client))

    def active_application(self, client: RawClient) -> int:
        """Return the active application's id.

        Raises:
            Differs: the camera does not answer with it.
        """
        answer = client.ask(m.Query())
        numbers = self.codec.read_numbers(answer.body)
        code_count = 1 if self.codec.dialect.coded else 0
        if len(numbers) <= code_count:
            raise Differs("the active application's id", self.codec.describe(answer))
        return numbers[code_count]

    def is_running(self, client: RawClient) -> bool:
        """Return True if the camera is in run mode; a BVS ID always is."""
        return self.codec.is_bid or bool(client.read_status() & self.codec.bits.running)

    @property
    def application(self) -> int:
        """Id of the application to trigger."""
        if self.options.application is not None:
            return self.options.application
        if self.state_before is None:
            raise NotObserved("there was no session yet")
        return self.state_before.application

    def require_allowed(self, needs: Allow) -> None:
        """Check that an action is allowed.

        Raises:
            NotObserved: the option does not allow this.
        """
        missing = needs & ~self._allow
        if missing:
            raise NotObserved(f"--camera-allow does not have {' and '.join(missing.names)}")

    def ensure_stopped(self, client: RawClient) -> None:
        """Stop the camera if it is in run mode.

        Raises:
            NotObserved: Stop is not allowed.
            Differs: the camera does not stop.
        """
        bits = self.codec.bits
        if self.codec.is_bid or not client.read_status() & bits.running:
            return
        self.require_allowed(Allow.RUN)
        client.send(m.Stop())
        client.wait_status(
            lambda word: not word & bits.running, self.options.timeout, "a status without Running"
        )

    def ensure_running(self, client: RawClient) -> None:
        """Start the camera unless it is in run mode; raises as :meth:`ensure_stopped`."""
        bits = self.codec.bits
        if self.codec.is_bid or client.read_status() & bits.running:
            return
        self.require_allowed(Allow.RUN)
        client.send(m.Start())
        client.wait_status(
            lambda word: word & bits.running, self.options.timeout, "a status with Running"
        )

    def load_application(self, client: RawClient, application: int) -> list[ReceivedFrame]:
        """Load an application; return the frames until the switch is complete.

        Raises:
            NotObserved: the switch is not allowed, or the camera refuses it.
            Differs: the switch is not answered, or leads to another application.
        """
        if self.active_application(client) == application:
            return []
        self.require_allowed(Allow.SWITCH)
        self.ensure_stopped(client)
        start_index = len(client.received)
        answer = client.ask(
            m.SwitchApplication(application=application), timeout=self.options.switch_timeout
        )
        code, active = (*self.codec.read_numbers(answer.body), -1, -1)[:2]
        if code:
            raise NotObserved(
                f"the camera does not load application {application}: {self.codec.describe(answer)}"
            )
        if active != application:
            raise Differs(f"application {application} in the answer", self.codec.describe(answer))
        bits = self.codec.bits
        client.wait_status(
            lambda word: word & bits.ready if self.codec.is_bid else not word & bits.busy,
            self.options.switch_timeout,
            "a status that is not busy",
        )
        return client.received[start_index:]

    def ensure_ready(self, client: RawClient) -> None:
        """Load and start the application, and wait until it waits for a trigger.

        Raises:
            NotObserved: a switch is not allowed, or the application needs no trigger.
            Differs: the camera does not load or start the application.
        """
        self.load_application(client, self.application)
        self.ensure_running(client)
        self.wait_until_waiting(client)

    def wait_until_waiting(self, client: RawClient) -> None:
        """Wait until the camera waits for a trigger; raises as :meth:`ensure_ready`."""
        if self._observations.get("runs free") == self.application:
            raise NotObserved(f"application {self.application} runs without triggers")
        waiting = self.codec.bits.waiting
        try:
            client.wait_status(
                lambda word: word & waiting,
                self.options.timeout,
                "a status with Waiting for Trigger",
            )
        except Differs as exc:
            self._observations["runs free"] = self.application
            raise NotObserved(
                f"application {self.application} did not wait for a trigger within "
                f"{self.options.timeout:g} s: {exc.observed}"
            ) from exc

    # ------------------------------------------------------------------ afterwards

    def restore(self, *, retry: bool = False) -> None:
        """Restore the active application and the run mode, and never raise.

        It tries up to two sessions. If both fail, :attr:`not_restored` gets the reason, and later
        calls do nothing unless ``retry`` is set.
        """
        before, reason = self.state_before, ""
        if not self._state_changed or before is None or (self.not_restored and not retry):
            return
        old_reason, self.gone_reason = self.gone_reason, ""
        for _ in range(RESTORE_ATTEMPTS):
            try:
                with self.session() as client:
                    self._restore_state(client, before)
            except (NotObserved, Differs, LinkClosedError) as exc:
                reason = str(exc)
                if self.gone_reason:
                    break
            else:
                self._state_changed = False
                self.not_restored = ""
                return
        self.gone_reason = self.gone_reason or old_reason
        run = "running" if before.running else "stopped"
        self.not_restored = (
            f"application {before.application}, {run}, could not be put back: {reason}"
        )

    def _restore_state(self, client: RawClient, before: StateBefore) -> None:
        allowed = self._allow
        self._allow |= Allow.RUN | Allow.SWITCH  # needed to undo our own changes
        try:
            self.load_application(client, before.application)
            (self.ensure_running if before.running else self.ensure_stopped)(client)
        finally:
            self._allow = allowed


async def _probe(address: Address) -> Address | str:
    """Return the address with its dialect, or the outcome of each try as text."""
    tried: list[str] = []
    outcome: Address | str | None = None
    async with contextlib.aclosing(try_ways(address, timeout=DETECTION_TIMEOUT)) as attempts:
        async for attempt in attempts:
            if attempt.address.scheme != address.scheme:
                break
            if attempt.answer is not None:
                outcome = parse_address(attempt.answer.url)
                break
            tried.append(str(attempt))
    return outcome or "; ".join(tried)
