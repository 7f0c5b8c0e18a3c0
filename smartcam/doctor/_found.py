"""Results of a search for cameras: which protocols open ports may use, and what answered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from smartcam._arguments import check_integer, check_iterable, check_text
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError, PluginError
from smartcam.protocols import Protocol, Transport
from smartcam.registry import PROTOCOLS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from smartcam.doctor._opening import OpenedPort
    from smartcam.doctor._probing import CameraAnswer

Evidence = Literal["greeted", "silent", "said", "ended", "other"]

MAX_PORTS = 32
"""Largest number of ports of one address that a search opens."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundPort:
    """A port that accepted a connection.

    Attributes:
        host: address of the host.
        port: number of the port.
        protocols: names of the protocols that the port may use, the most probable first; empty if
            the received bytes fit none.
        evidence: ``greeted``: the port sent the greeting of the protocol's cameras; ``silent``: it
            sent nothing, like cameras of the protocol; ``said``: it sent something, which cannot be
            compared, since the cameras' greeting is unknown; ``ended``: it closed the connection at
            once, as a camera with a client may; ``other``: no camera of a known protocol.
        received: bytes that the port sent without a request, up to 512.
        seconds: time until the connection was open.
        answer: the camera's description of itself, if it was asked and has answered.
        refusal: reason why the camera did not answer, if it was asked.
    """

    host: str
    port: int
    protocols: tuple[str, ...]
    evidence: Evidence
    received: bytes
    seconds: float
    answer: CameraAnswer | None = None
    refusal: str = ""

    @property
    def urls(self) -> tuple[str, ...]:
        """The port's address in each protocol; after an answer, in the answered protocol only."""
        if self.answer is not None:
            return (self.answer.url,)
        host = f"[{self.host}]" if ":" in self.host else self.host
        known = tcp_protocols()
        return tuple(f"{_tcp_scheme(known[name])}://{host}:{self.port}" for name in self.protocols)

    @property
    def greeting(self) -> str:
        """The first line that the port sent without a request, unprintable characters as dots."""
        lines = self.received.decode("latin-1").strip().splitlines()
        return (
            "".join(c if c.isascii() and c.isprintable() else "." for c in lines[0])
            if lines
            else ""
        )


# ---------------------------------------------------------------------- protocols


def tcp_protocols() -> dict[str, Protocol]:
    """Return the protocols over TCP, by name; protocols that cannot be loaded are left out."""
    protocols: dict[str, Protocol] = {}
    for info in PROTOCOLS.available():
        try:
            protocol = PROTOCOLS.load(info.name)
        except PluginError:
            if info.origin == "built-in":
                raise
            continue  # a broken plug-in is left out
        if isinstance(protocol, Protocol) and Transport.TCP in protocol.schemes.values():
            protocols[info.name] = protocol
    return protocols


def choose_ports(
    more_ports: Iterable[int], names: Iterable[str] | None
) -> dict[int, tuple[Protocol, ...]]:
    """Return the ports to open, and for each the protocols that it may use.

    Raises:
        ConfigurationError: a name is no protocol over TCP, or a number is no port.
    """
    known = tcp_protocols()
    chosen = [*known]
    if names is not None:
        given_names = check_iterable(names, "protocols", "names of protocols", "find")
        chosen = [*dict.fromkeys(check_text(name, "protocol", "find") for name in given_names)]
    for name in chosen:
        if name not in known:
            raise ConfigurationError(
                f"find: no protocol {name!r} over TCP is known; there are {', '.join(known)}"
                f"{did_you_mean(name, known)}"
            )
    if not chosen:
        raise ConfigurationError("find: no protocol is named")
    by_port: dict[int, tuple[Protocol, ...]] = {}
    for name in chosen:
        port = known[name].default_port
        by_port[port] = (*by_port.get(port, ()), known[name])
    for number in check_iterable(more_ports, "ports", "numbers of ports", "find"):
        port = check_integer(number, "port", 1, 0xFFFF, "find")
        port_protocols = by_port.get(port, ())
        by_port[port] = (
            *port_protocols,
            *(known[name] for name in chosen if known[name] not in port_protocols),
        )
    if len(by_port) > MAX_PORTS:
        raise ConfigurationError(f"find: {len(by_port)} ports: expected {MAX_PORTS} at most")
    return by_port


def may_serve_one_client(protocol: Protocol) -> bool:
    """Return True if some cameras of a protocol serve only one client."""
    return any(dialect.exclusive for dialect in protocol.dialects.values())


def _tcp_scheme(protocol: Protocol) -> str:
    return next(name for name, transport in protocol.schemes.items() if transport is Transport.TCP)


def check_consent(ports: Mapping[int, tuple[Protocol, ...]]) -> None:
    """Raise ConfigurationError if asking at these ports may take a camera from its client."""
    protocols = [protocol for port_protocols in ports.values() for protocol in port_protocols]
    names = sorted({protocol.name for protocol in protocols if may_serve_one_client(protocol)})
    if names:
        raise ConfigurationError(
            f"find: cameras of {', '.join(names)} serve one client, and asking takes them from it; "
            "so none is asked without consent. Say may_disturb=True (--may-disturb) when a lost "
            "session does no harm, ask other protocols only (protocols, --protocol), or ask none; "
            "excluded addresses (exclude, --exclude, --fleet) are not touched"
        )


# ---------------------------------------------------------------------- received bytes


def describe_port(
    host: str, port: int, opened: OpenedPort, protocols: tuple[Protocol, ...]
) -> FoundPort:
    """Return the description of an open port: the protocols that fit the received bytes."""
    received = opened.received.lstrip()
    greeted = [
        protocol
        for protocol in protocols
        if protocol.greeting and received.startswith(protocol.greeting)
    ]
    possible = greeted or [protocol for protocol in protocols if _may_use(protocol, opened)]
    evidence: Evidence = "silent"
    if greeted:
        evidence = "greeted"
    elif not possible:
        evidence = "other"
    elif opened.received:
        evidence = "said"
    elif opened.is_closed:
        evidence = "ended"
    return FoundPort(
        host=host,
        port=port,
        protocols=tuple(protocol.name for protocol in possible),
        evidence=evidence,
        received=opened.received,
        seconds=opened.seconds,
    )


def _may_use(protocol: Protocol, opened: OpenedPort) -> bool:
    """Return True if a camera of the protocol may behave like this port, which sent no greeting."""
    if opened.received:
        return protocol.greeting is None
    # a camera that has a client already may close the connection before its greeting
    return opened.is_closed or not protocol.greeting


def is_decided(received: bytes, protocols: tuple[Protocol, ...]) -> bool:
    """Return True if further bytes cannot change the evidence of an open port."""
    start = received.lstrip()
    if not start:
        return False
    for protocol in protocols:
        if protocol.greeting is None or (protocol.greeting and protocol.greeting.startswith(start)):
            return False
        if protocol.greeting and start.startswith(protocol.greeting):
            return b"\n" in start
    return True
