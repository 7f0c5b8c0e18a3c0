"""Run an emulated BVS camera on a port: connect sockets and a clock with the device.

Received bytes go ``socket -> ClientLink -> Machine -> EmulatedCamera.received ->
Device.handle``; the device's messages go ``Device.take_output -> Machine -> one write``.
Every action is a *step*: advance the device's time, act, deliver the device's messages, and set one
timer for the device's next event.
"""

from __future__ import annotations

import dataclasses
import logging
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from smartcam._arguments import check_application, check_flag, check_port, check_seed, check_text
from smartcam.emulator._bvs.behaviour import behaviour_of
from smartcam.emulator._bvs.clock_and_input import LOST_CLOCK
from smartcam.emulator._bvs.device import Device
from smartcam.emulator._client_link import MAX_INPUT_BYTES, SecondClientSession
from smartcam.emulator._clock import ManualClock, nanoseconds
from smartcam.emulator._inspected import InspectedApplication
from smartcam.emulator._scenario.merge import make_plan
from smartcam.emulator._scenario.states import DeviceState
from smartcam.emulator._scene import TableScene
from smartcam.emulator._wire_camera import WireCamera
from smartcam.emulator.faults._matching import find_unsupported
from smartcam.exceptions import ConfigurationError, FrameError
from smartcam.models import Status
from smartcam.protocols import BVS, Machine, Role, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import POLICIES, SHOWS_TRIGGERS, Policy
from smartcam.settings import Address

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from smartcam.emulator._application import Application
    from smartcam.emulator._bvs.device import LastReport
    from smartcam.emulator._bvs.quirks import Quirks
    from smartcam.emulator._client_link import ClientLink, Trace
    from smartcam.emulator._clock import Clock
    from smartcam.emulator._scenario.scenario import Mistake, Scenario
    from smartcam.emulator._scenario.timeline import Cue
    from smartcam.emulator.faults._base import BaseFault
    from smartcam.protocols import Frame, FramedDialect

CONDITIONS = {"overheat": Status.OVERHEAT, "system_error": Status.SYSTEM_ERROR}
"""The conditions that an operator can set and clear, by name."""

SHOWN_FIELDS = ("id", "name", "layout", "input", "rate", "load_time", "processing_time")
"""The fields of an application that the page shows."""

_MAX_NAMED_IDS = 20  # largest number of ids that an error names

_log = logging.getLogger("smartcam.emulator")

BAD_FRAME: Mapping[str, Policy] = {
    "skip": POLICIES[Role.CAMERA, Transport.TCP],
    "close": Policy(fatal=(FrameError,), exact_length=True),
}
"""Policies over TCP by value of the quirk ``bad_frame``; a broken body or an unknown id is always
ignored."""


class EmulatedCamera(WireCamera):
    """A BVS camera made of software, on a real port.

    ::

        async with EmulatedCamera(applications=[...]) as emulator:
            async with smartcam.connect(emulator.url) as camera:
                ...

    The given applications are added to the built-in ones (1, 3, 7, 9, 21) and replace those with
    the same id. The camera is stopped at first, unless ``running``.

    Args:
        applications: programs of the camera: :class:`Application` or mappings of its fields.
        scenario: a scenario or the path of its file; the other arguments override it.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one; default the scenario's, else 0.
        transport: ``"tcp"`` or ``"udp"``; default the scenario's, else ``"tcp"``.
        dialect: name of the wire dialect: ``handbook``, ``thesis``, ``b16`` or ``bid``; default
            the scenario's, else ``handbook``. ``bid`` is a BVS ID: it runs always, and
            answers every request with a result code.
        clock: clock of the camera; a :class:`ManualClock` in tests. Default: real time.
        quirks: choices where real cameras are unknown: :class:`Quirks` or a mapping of its fields.
        name: name of the camera in logs.
        active: id of the application that is loaded at first; default the first given one, else 1.
        running: True for run mode from the beginning.
        seed: seed of all random numbers, of the scene's noise and the timeline; default 0.
        builtins: add the built-in applications.
        faults: exact misbehaviour, in order: faults of :mod:`smartcam.emulator.faults`, or mappings
            of their fields with ``kind``. Faults that wait for no message happen at the start.
        timeline: events that happen by themselves, with their times: cues of
            :mod:`smartcam.emulator._scenario.timeline`, or mappings of their fields.
            They follow the scenario's.

    Attributes:
        host: the given host.
        transport: the transport in use.
        dialect: the dialect in use.
        name: the name in use.
        scenario: the scenario with all arguments merged into it.
        clock: clock that the camera runs by.
        device: the camera itself. Its operator's methods (``trigger()``,
            ``set_condition()``, ...) may be called at any time in the event loop's thread; the
            messages that they cause are sent. Its time is advanced at every action.
        seed: seed of all random numbers.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    accepted_options: ClassVar[frozenset[str]] = frozenset(
        {"scenario", "dialect", "transport", "seed", "web", "replay"}
    )
    states: ClassVar[frozenset[DeviceState]] = frozenset(DeviceState)

    def __init__(
        self,
        applications: Iterable[Application | dict[str, Any]] = (),
        *,
        scenario: Scenario | str | Path | None = None,
        host: str = "127.0.0.1",
        port: int | None = None,
        transport: Literal["tcp", "udp"] | None = None,
        dialect: str | None = None,
        clock: Clock | None = None,
        quirks: Quirks | dict[str, Any] | None = None,
        name: str | None = None,
        active: int | None = None,
        running: bool | None = None,
        seed: int | None = None,
        builtins: bool | None = None,
        faults: Iterable[BaseFault | Mapping[str, Any]] = (),
        timeline: Iterable[Cue | Mapping[str, Any]] = (),
    ) -> None:
        owner = "emulator"
        if port is not None:
            port = check_port(port, owner)
        if name is not None:
            name = check_text(name, "name", owner, most=200)
        if active is not None:
            active = check_application(active, "active", owner)
        if running is not None:
            running = check_flag(running, "running", owner)
        if seed is not None:
            seed = check_seed(seed, owner)
        if builtins is not None:
            builtins = check_flag(builtins, "builtins", owner)
        plan = make_plan(
            scenario,
            applications,
            timeline,
            port=port,
            transport=transport,
            dialect=dialect,
            quirks=quirks,
            name=name,
            active=active,
            running=running,
            seed=seed,
            builtins=builtins,
        )
        self.scenario: Scenario = plan
        wire_quirks = plan.quirks.of_the_wire
        self.wire_dialect: FramedDialect = BVS.dialects[plan.dialect].with_quirks(wire_quirks)
        self.device: Device = Device(
            plan.all_applications,
            active=plan.active,
            running=plan.running,
            quirks=plan.quirks,
            scene=TableScene(seed=plan.seed),
            clock_time=LOST_CLOCK if isinstance(clock, ManualClock) else datetime.now(UTC),
            behaviour=behaviour_of(self.wire_dialect, plan.quirks),
        )
        super().__init__(
            codec=self.wire_dialect,
            device=self.device,
            host=host,
            port=plan.port,
            transport=plan.transport,
            dialect=plan.dialect,
            name=plan.name,
            clock=clock,
            seed=plan.seed,
            timeline=plan.timeline,
            applications=self.device.applications,
        )
        self.device.action_context = self.step
        self._session_link: ClientLink | SecondClientSession | None = None
        self._advanced_at = 0.0
        self.queue.add(faults)

    @classmethod
    def from_scenario(
        cls,
        plan: Scenario,
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        transport: Literal["tcp", "udp"] | None = None,
        dialect: str | None = None,
        quirks: dict[str, Any] | None = None,
        clock: Clock | None = None,
        seed: int | None = None,
    ) -> EmulatedCamera:
        """Return a camera of a scenario; the other arguments override it."""
        own_quirks = plan.quirks.model_dump(exclude_unset=True)
        return cls(
            scenario=plan,
            host=host,
            port=port,
            transport=transport,
            dialect=dialect,
            quirks={**own_quirks, **quirks} if quirks else None,
            clock=clock,
            seed=seed,
        )

    @classmethod
    def mistake(cls, plan: Scenario) -> Mistake | None:
        """Return the path of an unsupported field in a scenario, and the reason; or None."""
        dialect = BVS.dialects[plan.dialect]
        known = [application.id for application in plan.all_applications]
        for number, application in enumerate(plan.applications):
            ids = dialect.application_ids
            if application.id not in ids:
                text = (
                    f"application id {application.id} does not fit dialect {dialect.name}: "
                    f"{ids.start} to {ids.stop - 1}"
                )
                return ("applications", number, "id"), text
        if plan.active is not None and plan.active not in known:
            ids_text = ", ".join(str(number) for number in known[:_MAX_NAMED_IDS])
            ellipsis = ", ..." if len(known) > _MAX_NAMED_IDS else ""
            asked_text = f"the id {plan.active}" if plan.active.bit_length() < 64 else "such an id"
            return ("active",), f"no application has {asked_text}; there are {ids_text}{ellipsis}"
        try:
            wire_dialect = dialect.with_quirks(plan.quirks.of_the_wire)
        except ConfigurationError as exc:
            return ("quirks",), str(exc)
        for number, cue in enumerate(plan.timeline):
            for fault_index, fault in enumerate(cue.do):
                problem = find_unsupported(fault, wire_dialect, known)
                if problem is not None:
                    return ("timeline", number, "do", fault_index, problem[0]), problem[1]
        return None

    @classmethod
    def state_options(cls, active: int | None, *, running: bool) -> dict[str, Any]:
        """Return the options for a camera whose application is active, and runs, from the start."""
        return {"active": active, "running": running}

    # ------------------------------------------------------------------ properties

    @property
    def url(self) -> str:
        """The camera's address, in which the dialect is named."""
        kind = Transport(self.transport)
        scheme = next(s for s, t in BVS.schemes.items() if t is kind)
        hidden = self.device.quirks.hidden_triggers
        return Address(
            "bvs",
            scheme,
            self.host,
            self.port,
            self.dialect,
            self.wire_dialect.quirks,
            ((SHOWS_TRIGGERS, "no"),) if hidden else (),
        ).url

    @property
    def application_ids(self) -> list[int]:
        """Ids of the camera's applications."""
        return list(self.device.applications)

    def __repr__(self) -> str:
        return f"<EmulatedCamera {self.name} {self.url}>"

    @property
    def scene(self) -> TableScene:
        """The table that the camera sees, with the ground truth."""
        return self.device.scene

    @property
    def table(self) -> TableScene | None:
        """The table that its pages show; None if all applications inspect real pictures."""
        applications = self.device.applications.values()
        inspects = all(isinstance(each, InspectedApplication) for each in applications)
        return None if inspects else self.scene

    @property
    def clock_time(self) -> datetime:
        """Time that the camera's own clock shows."""
        return self.device.clock_time

    @property
    def last_report(self) -> LastReport | None:
        """The last run's result, even if no client received it; its time is as in the log."""
        last = self.device.last_report
        if last is None:
            return None
        return last._replace(time=self._advanced_at - (self.device.time - last.time))

    def application_of(self, message: m.ResultContainer) -> Application | None:
        """Return the application that describes a result; None without one."""
        return self.device.applications.get(message.application)

    def shown(self) -> dict[str, Any]:
        """Return the state of the camera that its page shows."""
        device = self.device
        return {
            **super().shown(),
            "mode": device.mode,
            "status": device.status,
            "active_application": device.active_application,
            "conditions": {name: bit in device.status for name, bit in CONDITIONS.items()},
            "running": device.running,
            "processing": device.processing,
            "endian": device.endian,
            "next_number": device.next_number,
            "queued_inputs": device.queued_inputs,
            "applications": [
                {key: getattr(each, key) for key in SHOWN_FIELDS}
                for each in device.applications.values()
            ],
            "quirks": self.quirks,
            "quirks_chosen": self.quirks.model_dump(exclude_defaults=True),
        }

    @property
    def quirks(self) -> Quirks:
        """The camera's quirks."""
        return self.device.quirks

    @property
    def has_session(self) -> bool:
        """True while a client has the session."""
        return self._session_link is not None

    @property
    def sessions(self) -> list[str]:
        """Address and port of the client that has the session; empty without one."""
        return [] if self._session_link is None else [self._session_link.peer]

    # ------------------------------------------------------------------ links and the session

    def make_machine(self, transport: Transport, trace: Trace) -> Machine:
        """Return the machine of a new link."""
        return Machine(
            self.wire_dialect,
            Role.CAMERA,
            transport,
            max_length=MAX_INPUT_BYTES,
            policy=self._policy(transport),
            trace=trace,
        )

    def _policy(self, transport: Transport) -> Policy:
        """Return the policy for broken input."""
        tcp = transport is Transport.TCP
        policy = BAD_FRAME[self.quirks.bad_frame] if tcp else POLICIES[Role.CAMERA, transport]
        return dataclasses.replace(
            policy, reports_malformed=self.device.behaviour.answers_bad_messages
        )

    def handle_message(self, link: ClientLink, message: m.Message) -> None:
        """Handle a message of a link; without the session only Connect has an effect."""
        connects = isinstance(message, m.Connect)
        if not connects and link is not self._session_link:
            return
        faults = self._fire_before(self.queue.client_device_faults, message)
        if connects and not link.closed:
            self._connect(link)
        elif link is self._session_link:  # a fault may have given the session to another
            self.device.handle(message)
            if isinstance(message, m.Disconnect):
                self._collect()
                self._session_link = None
                link.session_ended()
        self._collect()
        self.device.report_entered()
        if faults:
            self._run_device_faults(faults, "after")

    def serves(self, link: ClientLink) -> bool:
        """Return True if the link has the session."""
        return link is self._session_link

    def forget_link(self, link: ClientLink) -> None:
        """Forget a link that is gone; end its session, if it has the session."""
        if link is self._session_link:
            self._end_session()

    def _let_second_client_in(self) -> None:
        """Let another client connect; it gets the session unless a quirk refuses newcomers."""
        if (
            self.device.rebooting
            or self._refusal_timer is not None
            or not self._may_take_over(None)
        ):
            return
        self._give_session(SecondClientSession(self.wire_dialect, self._note_second_client))

    def _note_second_client(self, frame: Frame) -> None:
        self._log_content(SecondClientSession.peer, m.Sender.CAMERA, frame, "second_client", b"")

    def _connect(self, link: ClientLink) -> None:
        """Give the session to ``link``: the newcomer wins, unless a quirk says otherwise."""
        if not self._may_take_over(link):
            link.close("another client has the session")
            return
        self._give_session(link)

    def _may_take_over(self, newcomer: ClientLink | None) -> bool:
        free = self._session_link is None or self._session_link is newcomer
        return free or self.transport != "tcp" or self.quirks.second_client != "refuse"

    def _give_session(self, newcomer: ClientLink | SecondClientSession) -> None:
        old = self._session_link
        if old is not None and old is not newcomer:
            self._end_session()
            old.dismiss(f"{newcomer.peer} takes the session over")
        self._session_link = newcomer
        self.device.handle(m.Connect())

    def _end_session(self) -> None:
        self._session_link = None
        self.device.disconnect()

    # ------------------------------------------------------------------ steps

    def _after_start(self) -> None:
        self._advanced_at = self.clock.now
        if self._timeline.watches_states:
            self.device.watch(self._on_state_entered)

    def _before_stop(self) -> None:
        if isinstance(self._session_link, SecondClientSession):
            self._end_session()

    def _end_device_faults(self) -> None:
        self.device.end_faults()
        self._before_stop()

    def _deliver_at_once(self) -> None:
        self._send_all(self.device.take_output(), fire_faults=False)

    def _advance_device(self, now: float) -> None:
        passed, self._advanced_at = now - self._advanced_at, now
        self.device.tick(max(0.0, passed))

    def _collect(self) -> None:
        """Put the device's messages into the active link's next write."""
        output = self.device.take_output()
        if self.queue.camera_device_faults:
            self._send_all(output, fire_faults=True)
        elif self._session_link is not None:
            for message in output:
                self._session_link.send(message)

    def _send_all(self, output: list[m.Message], *, fire_faults: bool) -> None:
        """Send messages to the client that has the session; they may trigger faults."""
        session, waiting = self._session_link, self.queue.camera_device_faults
        for message in output:
            faults = self._fire_before(waiting, message) if fire_faults else ()
            if session is not None and session is self._session_link and self.device.connected:
                session.send(message)
            self._run_device_faults(faults, "after")

    def _finish_step(self) -> None:
        self.device.report_entered()
        self._collect()
        if self._session_link is not None:
            self._session_link.flush()
        if self.device.rebooting and not self._is_down:
            self._go_down()
        elif self._is_down and not self.device.rebooting:
            self._come_up()
        delay = self.device.next_event_in()
        self._timer.set(None if delay is None else nanoseconds(self._advanced_at + delay))

    # ------------------------------------------------------------------ the port

    def _go_down(self) -> None:
        """Restart: close every connection and the port."""
        _log.info("= %s: rebooting", self.name)
        self._is_down = True
        self._session_link = None
        self._port.close_with_links()

    def _come_up(self) -> None:
        """Come back after a restart."""
        _log.info("= %s: up again", self.name)
        self._is_down = False
        if self._refusal_timer is None:
            self._port.reopen()
