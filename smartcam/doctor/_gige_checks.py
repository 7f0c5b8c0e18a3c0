"""Examine a GigE Vision camera and the network for reasons why no pictures come."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
import struct
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from smartcam.doctor._findings import Exit, Finding, Severity
from smartcam.exceptions import FrameFormatError, FrameSourceError, FrameTimeoutError
from smartcam.frames import FrameAddress
from smartcam.frames import open as open_frames
from smartcam.frames._inside import (
    ControlChannel,
    GigESession,
    Register,
    camera_url,
    discovery,
)

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping

    from smartcam.frames._inside import GenicamFeatures, GigEDriver, PacketCounts

PACKET_OVERHEAD_BYTES: Final = 36 + 38
"""Bytes of a stream's packet in addition to the pixels: headers of IP, UDP and GVSP, and the
Ethernet frame."""

STANDARD_MTU: Final = 1500
JUMBO_MTU: Final = 9000

MAX_LINK_LOAD: Final = 0.9
"""A stream that uses more than this part of a link's speed loses packets, in this machine or in a
switch."""

SMALL_BUFFER_BYTES: Final = 1 << 20
"""With a smaller receive buffer, bytes, a busy machine loses packets of a large picture."""

SPEED_UNKNOWN: Final = 0.0

_SIOCGIFADDR: Final = 0x8915  # linux/sockios.h

MEASURE_HINT: Final = "`smartcam frames measure` shows the same for as long as you like."


class _ExaminationOverError(Exception):
    """The examination cannot continue."""


@dataclass(eq=False)
class _GigEExamination:
    """One examination: its options, and its findings so far."""

    address: FrameAddress
    seconds: float
    timeout: float
    findings: list[Finding] = field(default_factory=list[Finding])
    check: str = ""
    host: str = ""
    port: int = 0
    label: str = ""
    path_mtu: int = STANDARD_MTU
    local_address: str = ""
    payload_bytes: int = 0
    frame_rate: float | None = None
    camera_link_speed: float = SPEED_UNKNOWN  # bits per second

    def add(
        self,
        severity: Severity,
        text: str,
        cure: str = "",
        exit_code: Exit = Exit.DONE,
        details: Mapping[str, Any] | None = None,
    ) -> None:
        """Add a finding."""
        finding = Finding(
            check=self.check,
            severity=severity,
            text=text,
            cure=cure,
            details=details or {},
            exit_code=exit_code,
        )
        self.findings.append(finding)

    def fail(
        self,
        text: str,
        cure: str,
        exit_code: Exit = Exit.NO_SESSION,
        details: Mapping[str, Any] | None = None,
    ) -> _ExaminationOverError:
        """Add an error, and return the exception that ends the examination."""
        self.add("error", text, cure, exit_code, details)
        return _ExaminationOverError()


async def examine_gige(
    url: str, *, seconds: float, timeout: float | None
) -> AsyncGenerator[Finding]:
    """Examine a camera and yield each finding at once.

    The examination takes control of the camera only if no other program has it, and lets the camera
    stream by the URL's settings.

    Raises:
        ConfigurationError: the URL is wrong; nothing was tried.

    Cancellation: the camera is given back.
    """
    address = FrameAddress.parse(url)
    camera_url.read_wanted_stream(address)  # checks the URL
    exam = _GigEExamination(address, seconds, timeout or 5.0)
    checks: tuple[tuple[str, Callable[[_GigEExamination], Awaitable[None]]], ...] = (
        ("address", _find_address),
        ("subnet", _look_at_networks),
        ("answers", _ask_camera),
        ("control", _look_at_control),
        ("link", _check_link),
        ("stream", _check_stream),
    )
    for exam.check, check in checks:
        is_over = False
        try:
            await check(exam)
        except _ExaminationOverError:
            is_over = True
        except FrameSourceError as exc:
            exam.fail(f"this check failed: {exc}", "", Exit.NO_SESSION)
            is_over = True
        findings, exam.findings = exam.findings, []
        for finding in findings:
            yield finding
        if is_over:
            return


# ---------------------------------------------------------------------- the network


async def _find_address(exam: _GigEExamination) -> None:
    """Check ``address``: find the address that the URL means."""
    try:
        host, exam.port = await camera_url.find_camera(
            exam.address, camera_url.read_wanted_stream(exam.address)
        )
        addresses = await asyncio.get_running_loop().getaddrinfo(host, None, family=socket.AF_INET)
    except FrameSourceError as exc:
        raise exam.fail(
            str(exc),
            "Write its address, gige://HOST. A search reaches the networks of this machine alone, "
            "and a firewall that drops answers from UDP port 3956 makes it find nothing.",
        ) from exc
    except OSError as exc:
        raise exam.fail(
            f"the name {exam.address.host} has no IPv4 address: {exc}", "Write the address itself."
        ) from exc
    exam.host = str(addresses[0][4][0])
    exam.add("ok", f"the camera is looked for at {exam.host}, UDP port {exam.port}")


async def _look_at_networks(exam: _GigEExamination) -> None:
    """Check ``subnet``: whether the camera's address is in one of this machine's networks."""
    networks = [network for network in discovery.networks() if network.network is not None]
    if not networks:
        exam.add("hint", "the networks of this machine cannot be listed here")
        return
    host = ipaddress.IPv4Address(exam.host)
    networks_of_camera = [
        network for network in networks if network.network is not None and host in network.network
    ]
    networks_text = ", ".join(f"{network.address} in {network.network}" for network in networks)
    if not networks_of_camera:
        exam.add(
            "warning",
            f"{exam.host} is of another subnet than this machine: {networks_text}",
            f"Give the camera an address of a network here, or this machine one of {exam.host}'s: "
            "by the maker's tool (ForceIP), or by ip address add. Through a router a camera is not "
            "found by a search, and its stream rarely comes.",
            details={"networks": [str(network.network) for network in networks]},
        )
    elif len(networks_of_camera) > 1:
        exam.add(
            "warning",
            f"{exam.host} is of {len(networks_of_camera)} networks of this machine: "
            + ", ".join(
                f"{network.address} in {network.network}" for network in networks_of_camera
            ),
            "Give the two interfaces different subnets: the system sends by one of them, which may "
            "be the wrong one.",
        )
    else:
        exam.add("ok", f"{exam.host} is of the same subnet: {networks_of_camera[0].network}")


async def _ask_camera(exam: _GigEExamination) -> None:
    """Check ``answers``: read a register that every program may read."""
    try:
        control = await ControlChannel.connect(exam.host, exam.port, exam.address.shown)
    except FrameSourceError as exc:
        raise exam.fail(
            f"this machine has no route to the camera: {exc}",
            "Give this machine an address of the camera's network, or the camera one of this "
            "machine's.",
        ) from exc
    try:
        exam.local_address, exam.path_mtu = control.local_address, control.path_mtu
        start = time.monotonic()
        try:
            privilege = await control.read_register(Register.CONTROL_PRIVILEGE)
        except FrameSourceError as exc:
            raise await _no_answer_error(exam, exc) from exc
        round_trip = time.monotonic() - start
        owner_address = await _register_or_0(control, Register.PRIMARY_APPLICATION_ADDRESS)
    finally:
        control.close()
    exam.add(
        "ok", f"it answers, after {round_trip * 1e3:.1f} ms", details={"round_trip": round_trip}
    )
    exam.check = "control"
    if privilege:
        owner_text = f" at {ipaddress.IPv4Address(owner_address)}" if owner_address else ""
        is_on_this_machine = owner_address and str(ipaddress.IPv4Address(owner_address)) in {
            network.address for network in discovery.networks()
        }
        raise exam.fail(
            f"another application{owner_text} controls it"
            f"{', on this machine' if is_on_this_machine else ''}; only one at a time can",
            "Close the other program: a viewer of the maker, a process of yours that is left over, "
            "an agent. One that was killed loses the camera after its heartbeat's time, some "
            "seconds; while a debugger holds a program, that time can be minutes.",
            details={"controlled_by": owner_text.removeprefix(" at ")},
        )


async def _no_answer_error(
    exam: _GigEExamination, error: FrameSourceError
) -> _ExaminationOverError:
    """Return the error that nothing answered, with the cause if it can be found."""
    cameras = await discovery.find_cameras(discovery.networks())
    cameras_there = [
        camera for camera in cameras if exam.host in (camera.address, camera.info.address)
    ]
    cameras_text = ", ".join(f"gige://{camera.address} {camera.info.label}" for camera in cameras)
    if "refused" in str(error).lower():
        return exam.fail(
            f"{exam.host} is there, and nothing listens at UDP port {exam.port}: it is no GigE "
            "Vision camera, or its service is down",
            f"Found on this machine's networks: {cameras_text}."
            if cameras_text
            else "See whether the address is the camera's, and switch it off and on.",
        )
    if cameras_there:
        return exam.fail(
            f"it answers a search, and not a question to {exam.host} itself"
            + (
                ""
                if cameras_there[0].reachable
                else f": its address {cameras_there[0].info.address} is of another subnet"
            ),
            "Give it an address of this subnet (ForceIP), or let UDP port 3956 through the "
            "firewall in both directions.",
        )
    return exam.fail(
        f"nothing answers at {exam.host}, UDP port {exam.port}: {error}",
        (
            f"Cameras that answer a search: {cameras_text}. Is it one of these?"
            if cameras_text
            else "See to its power, cable and address (ping), then to a firewall, which must let "
            "UDP port 3956 through: nothing answered a search either."
        ),
        details={"others": [camera.address for camera in cameras]},
    )


async def _register_or_0(control: ControlChannel, address: int) -> int:
    with contextlib.suppress(FrameSourceError):
        return await control.read_register(address)
    return 0


async def _look_at_control(exam: _GigEExamination) -> None:
    """Check ``control``: take control of the camera and read its features."""
    async with _FeatureSession(exam) as features:
        exam.add("ok", f"{exam.label}: no program controlled it, and this one may")
        exam.payload_bytes = int(await _read_number(features, "PayloadSize") or 0)
        exam.frame_rate = await _read_number(
            features, "AcquisitionResultingFrameRate", "ResultingFrameRate", "AcquisitionFrameRate"
        )
        bytes_a_second = await _read_number(features, "DeviceLinkSpeed")
        megabits = await _read_number(features, "GevLinkSpeed")
        exam.camera_link_speed = (bytes_a_second or 0) * 8 or (megabits or 0) * 1e6
        mode = await _read_text(features, "AcquisitionMode")
    exam.check = "features"
    if mode not in ("", "Continuous"):
        exam.add(
            "hint",
            f"AcquisitionMode is {mode}: a program that does not set it gets a picture or a few, "
            "and then none",
            "smartcam sets Continuous when it opens the camera.",
        )


class _FeatureSession:
    """A context that takes control of the camera and gives its features."""

    def __init__(self, exam: _GigEExamination) -> None:
        self._exam = exam
        self._session: GigESession | None = None

    async def __aenter__(self) -> GenicamFeatures:
        exam = self._exam
        self._session = await GigESession.open(exam.host, exam.port, exam.address.shown)
        exam.label = self._session.label
        return self._session.features

    async def __aexit__(self, *_: object) -> None:
        if self._session is not None:
            await self._session.close()


async def _read_number(features: GenicamFeatures, *names: str) -> float | None:
    """Return the first feature of these names that the camera has, as a number."""
    for name in names:
        if name in features:
            with contextlib.suppress(FrameSourceError):
                number = await features.number(name)
                if number is not None:
                    return float(number)
    return None


async def _read_text(features: GenicamFeatures, name: str) -> str:
    if name in features:
        with contextlib.suppress(FrameSourceError):
            return str(await features.get(name))
    return ""


async def _check_link(exam: _GigEExamination) -> None:
    """Check ``link`` and ``buffer``: the link's speed, and this machine's receive buffer."""
    exam.check = "link"
    own_speed = _link_speed(exam.local_address)
    known_speeds = [speed for speed in (own_speed, exam.camera_link_speed) if speed]
    if exam.payload_bytes and exam.frame_rate and known_speeds:
        _look_at_bandwidth(exam, min(known_speeds))
    elif known_speeds:
        exam.add("ok", f"the link has {min(known_speeds) / 1e6:,.0f} Mbit/s")
    exam.check = "buffer"
    max_buffer = _max_receive_buffer()
    if max_buffer is not None and max_buffer < SMALL_BUFFER_BYTES:
        exam.add(
            "hint",
            f"a program may have {max_buffer:,} bytes of receive buffer, which a busy machine "
            "fills before it reads: then packets are lost",
            "sysctl net.core.rmem_max=8388608",
            details={"rmem_max": max_buffer},
        )


def _look_at_bandwidth(exam: _GigEExamination, link: float) -> None:
    packet_bytes = min(exam.path_mtu, JUMBO_MTU)
    overhead_factor = 1 + PACKET_OVERHEAD_BYTES / max(1, packet_bytes - 36)
    needed = exam.payload_bytes * 8 * (exam.frame_rate or 0.0) * overhead_factor
    text = (
        f"{exam.payload_bytes:,} bytes a picture, {exam.frame_rate:.4g} a second: "
        f"{needed / 1e6:,.0f} Mbit/s of a link of {link / 1e6:,.0f}"
    )
    details = {"needed": needed, "link": link}
    if needed > MAX_LINK_LOAD * link:
        max_rate = MAX_LINK_LOAD * link / (exam.payload_bytes * 8 * overhead_factor)
        exam.add(
            "error",
            f"{text}: it does not fit",
            f"Ask for less: ?fps={max_rate:.3g} or lower, a smaller ?size=, or a format of fewer "
            "bits. See whether the cable or a switch made the link slow. Several cameras on one "
            "link share it.",
            Exit.REFUSED,
            details=details,
        )
    else:
        exam.add("ok", text, details=details)


def _link_speed(local_address: str) -> float:
    """Return the speed of the interface with an address, bits per second; 0 if it is not known."""
    if sys.platform != "linux":
        return SPEED_UNKNOWN
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError, ValueError):
                request = struct.pack("256s", name.encode()[:15])
                answer = fcntl.ioctl(sock.fileno(), _SIOCGIFADDR, request)
                if socket.inet_ntoa(answer[20:24]) == local_address:
                    megabits = int(Path(f"/sys/class/net/{name}/speed").read_text())
                    return max(0, megabits) * 1e6
    return SPEED_UNKNOWN


def _max_receive_buffer() -> int | None:
    """Return the largest receive buffer that a program gets, in bytes; None if it is not known."""
    try:
        return int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return None


# ---------------------------------------------------------------------- the stream


@dataclass(slots=True)
class _StreamObservation:
    """The frames and packets of a stream that arrived while it was watched.

    Attributes:
        frames: number of frames that came.
        counts: counts of their packets; None if the stream did not begin.
        packet_size: bytes of an IP packet.
        seconds: time for which the stream was watched.
    """

    frames: int
    counts: PacketCounts | None
    packet_size: int
    seconds: float


async def _check_stream(exam: _GigEExamination) -> None:
    """Check ``stream``: let the camera stream by the URL's options; count frames and packets."""
    try:
        stream = await _observe_stream(exam)
    except FrameTimeoutError as exc:
        raise exam.fail(str(exc), "", Exit.TIMED_OUT) from exc
    except FrameFormatError as exc:
        raise exam.fail(f"the stream: {exc}", "", Exit.REFUSED) from exc
    _look_at_packets(exam, stream)
    exam.check = "stream"
    if not stream.frames:
        await _explain_silence(exam, stream)
        return
    counts = stream.counts
    lost, requested = (0, 0) if counts is None else (counts.lost, counts.requested)
    details = {
        "frames": stream.frames,
        "lost": lost,
        "requested": requested,
        "seconds": stream.seconds,
    }
    text = f"{stream.frames} pictures in {stream.seconds:.1f} s"
    if lost or requested:
        exam.add(
            "warning" if lost else "hint",
            f"{text}; {lost} more lost for missing packets, {requested} packets asked for again",
            "Make room for the packets: large ones (an MTU of 9000 on each side and switch), "
            "net.core.rmem_max=8388608 against a machine that reads late, "
            "?feature.GevSCPD=1000 (a pause between packets) or fewer pictures against a link that "
            "is full; a bad cable or plug loses some at any speed.",
            details=details,
        )
    else:
        exam.add("ok", f"{text}, none lost, no packet asked for again", details=details)
    picture_interval = 1 / exam.frame_rate if exam.frame_rate else 0.0
    if picture_interval > exam.timeout:
        exam.add(
            "warning",
            f"a picture comes each {picture_interval:.3g} s, and a source waits "
            f"{exam.timeout:g} s for one",
            f"Wait longer: open(url, timeout={2 * picture_interval:.3g}, stall=None).",
        )


async def _observe_stream(exam: _GigEExamination) -> _StreamObservation:
    frames = 0
    source = open_frames(exam.address.url, timeout=None, stall=None)
    async with source:
        driver = cast("GigEDriver", source.driver)
        rates = source.format.rates
        exam.frame_rate = rates[0] if rates else exam.frame_rate
        loop = asyncio.get_running_loop()
        start = loop.time()
        async with source.reader() as reader:
            try:
                async with asyncio.timeout(exam.seconds):
                    async for _ in reader:
                        frames += 1
            except FrameSourceError:  # some FrameSourceErrors are TimeoutErrors, too
                raise
            except TimeoutError:
                pass
            else:
                raise FrameSourceError("the stream ended by itself", source=exam.label)
            counts, seconds = driver.counts, loop.time() - start
            packet_size = await _packet_size(exam)
    return _StreamObservation(frames, counts, packet_size, seconds)


async def _packet_size(exam: _GigEExamination) -> int:
    """Return the packet size of the camera's stream channel; any program may read it."""
    control = await ControlChannel.connect(exam.host, exam.port, exam.address.shown)
    try:
        return await _register_or_0(control, Register.STREAM_PACKET_SIZE) & 0xFFFF
    finally:
        control.close()


def _look_at_packets(exam: _GigEExamination, stream: _StreamObservation) -> None:
    exam.check, size = "packet size", stream.packet_size
    details = {"packet_size": size, "mtu": exam.path_mtu}
    if size > exam.path_mtu and stream.frames:
        exam.add(
            "warning",
            f"packets of {size} bytes come in pieces, since this machine's side takes "
            f"{exam.path_mtu} (MTU): a lost piece is a lost packet",
            f"Write ?packet_size={exam.path_mtu}, or raise the MTU: ip link set DEVICE mtu 9000.",
            details=details,
        )
    elif size > exam.path_mtu:
        exam.add(
            "error",
            f"packets of {size} bytes are asked for, and this machine's side takes {exam.path_mtu} "
            "(MTU): none of them comes",
            f"Write gige://{exam.host} without packet_size, so that smartcam finds the size, write "
            f"?packet_size={exam.path_mtu}, or raise the MTU: ip link set DEVICE mtu 9000.",
            Exit.REFUSED,
            details=details,
        )
    elif size < exam.path_mtu and size <= STANDARD_MTU < exam.path_mtu:
        exam.add(
            "hint",
            f"packets have {size} bytes, although this machine's side takes {exam.path_mtu} (MTU)",
            "A switch on the way, or the camera, takes no larger ones: raise its MTU, too. Small "
            "packets cost about three times the CPU time.",
            details=details,
        )
    elif size <= STANDARD_MTU:
        exam.add(
            "hint",
            f"packets have {size} bytes, the MTU is {exam.path_mtu}",
            "With an MTU of 9000 on both sides and on each switch a stream takes a third of the "
            "CPU time, and loses fewer packets on a busy machine.",
            details=details,
        )
    else:
        exam.add("ok", f"packets have {size} bytes, the MTU is {exam.path_mtu}", details=details)


async def _explain_silence(exam: _GigEExamination, stream: _StreamObservation) -> None:
    """Report why no picture came."""
    triggers = await _waiting_triggers(exam)
    counts = stream.counts
    if counts is not None and (counts.lost or counts.requested or counts.malformed):
        exam.add(
            "error",
            f"packets come, and no picture is whole: {counts.lost} pictures lost, "
            f"{counts.requested} packets asked for again, {counts.malformed} malformed",
            "The link or a switch drops many of them: see the findings above on packet size and "
            "bandwidth, and try ?size=320x240&fps=1.",
            Exit.TIMED_OUT,
            details={"lost": counts.lost, "requested": counts.requested},
        )
    elif triggers:
        exam.check = "trigger"
        exam.add(
            "error",
            f"TriggerMode is On ({triggers}), and no trigger came in {stream.seconds:.1f} s: the "
            "camera waits",
            "Trigger it, or have it run by itself: ?feature.TriggerMode=Off. If the source is an "
            "input line, check its wiring, TriggerActivation and the input's level.",
            Exit.TIMED_OUT,
            details={"trigger": triggers},
        )
    elif exam.frame_rate and 1 / exam.frame_rate > stream.seconds:
        exam.add(
            "warning",
            f"no picture came in {stream.seconds:.1f} s; one is due each "
            f"{1 / exam.frame_rate:.3g} s",
            f"Watch for longer: --seconds {3 / exam.frame_rate:.3g}.",
        )
    elif stream.packet_size <= exam.path_mtu:
        exam.add(
            "error",
            f"the camera obeys and streams, and no packet of the stream came in "
            f"{stream.seconds:.1f} s: something on the way drops UDP that this machine did not ask "
            "for",
            f"Let UDP from {exam.host} through the firewall of this machine, to any port "
            "(nft, ufw, firewalld, a virtual machine's NAT, a container without --network host). "
            f"{MEASURE_HINT}",
            Exit.TIMED_OUT,
        )


async def _waiting_triggers(exam: _GigEExamination) -> str:
    """Return the triggers that are on, with their sources; "" if none is on."""
    triggers: list[str] = []
    try:
        async with _FeatureSession(exam) as features:
            selectors, original_selector = [""], ""
            if "TriggerSelector" in features:
                selectors = list(await features.entries("TriggerSelector"))
                original_selector = await _read_text(features, "TriggerSelector")
            for selector in selectors:
                if selector:
                    await features.set("TriggerSelector", selector)
                if await _read_text(features, "TriggerMode") == "On":
                    source = await _read_text(features, "TriggerSource") or "unknown source"
                    triggers.append(f"{selector} by {source}" if selector else f"by {source}")
            if selectors != [""]:
                await features.set("TriggerSelector", original_selector)
    except FrameSourceError:
        pass
    return ", ".join(triggers)
