"""Parse the text of a network, a range, an address or a host's name, and list its addresses."""

from __future__ import annotations

import bisect
import ipaddress
import re
import socket
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    SocketAddress = tuple[str, int] | tuple[str, int, int, int]

MAX_IPV6 = 256
"""Largest number of addresses of an IPv6 network: trying a network of the usual size would never
end."""

_HOST_NAME = re.compile(r"(?=.*[A-Za-z])\w(?:[\w.-]{0,251}\w)?", re.ASCII)

_NETWORKS_WITHOUT_HOSTS = tuple(
    ipaddress.ip_network(network) for network in ("0.0.0.0/8", "224.0.0.0/3", "::/128", "ff00::/8")
)
"""Networks whose addresses no host has: unspecified, multicast and broadcast addresses."""

EXPECTED_TEXT = (
    "expected a network such as 192.168.0.0/24, a range such as 192.168.0.10-20, an address, or a "
    "host's name"
)


class HostAddress(NamedTuple):
    """An address of one host; sorts in numeric order."""

    version: int  # 4 or 6
    number: int
    scope: str = ""  # interface of a link-local IPv6 address

    def __str__(self) -> str:
        """Return the address as text."""
        kind = ipaddress.IPv4Address if self.version == 4 else ipaddress.IPv6Address
        return str(kind(self.number)) + (f"%{self.scope}" if self.scope else "")

    def sockaddr(self, port: int) -> tuple[socket.AddressFamily, SocketAddress]:
        """Return family and address for a socket."""
        if self.version == 4:
            return socket.AF_INET, (str(self), port)
        host = str(ipaddress.IPv6Address(self.number))
        return socket.AF_INET6, (host, port, 0, _interface_index(self.scope))


class Span(NamedTuple):
    """A range of addresses, including both ends."""

    first: HostAddress
    last: HostAddress

    @property
    def size(self) -> int:
        """The number of addresses."""
        return self.last.number - self.first.number + 1


class AddressSet:
    """Addresses in order, without duplicates."""

    def __init__(self, spans: Iterable[Span]) -> None:
        self._spans: list[Span] = []
        for span in sorted(spans, key=lambda span: (*_sort_key(span.first), span.last.number)):
            previous = self._spans[-1] if self._spans else None
            if (
                previous is not None
                and _network_kind(previous.last) == _network_kind(span.first)
                and span.first.number <= previous.last.number + 1
            ):
                self._spans[-1] = Span(previous.first, max(previous.last, span.last))
            else:
                self._spans.append(span)
        self._firsts = [_sort_key(span.first) for span in self._spans]

    def __len__(self) -> int:
        """Return the number of addresses."""
        return sum(span.size for span in self._spans)

    def __contains__(self, address: HostAddress) -> bool:
        """Return True if an address is in the set."""
        index = bisect.bisect_right(self._firsts, _sort_key(address)) - 1
        if index < 0:
            return False
        first, last = self._spans[index]
        same_kind = _network_kind(first) == _network_kind(address)
        return same_kind and first.number <= address.number <= last.number

    def without(self, others: AddressSet) -> AddressSet:
        """Return the addresses that are not in another set."""
        remaining: list[Span] = []
        for first, last in self._spans:
            for excluded in others._spans:
                if (
                    _network_kind(excluded.first) != _network_kind(first)
                    or excluded.last.number < first.number
                ):
                    continue
                if excluded.first.number > last.number:
                    break
                if excluded.first.number > first.number:
                    remaining.append(Span(first, first._replace(number=excluded.first.number - 1)))
                first = first._replace(number=excluded.last.number + 1)
                if first.number > last.number:
                    break
            if first.number <= last.number:
                remaining.append(Span(first, last))
        return AddressSet(remaining)

    def __iter__(self) -> Iterator[HostAddress]:
        """Yield each address."""
        for first, last in self._spans:
            for number in range(first.number, last.number + 1):
                yield first._replace(number=number)


def read_span(text: str, *, include_ends: bool = False) -> Span | None:
    """Return the addresses that a text means; None for a name, which has to be looked up.

    ``include_ends``: include an IPv4 network's first and last address, which belong to no host in
    it, but may belong to a host in a larger network.

    Raises:
        ConfigurationError: the text means no address, an address that no host has, or too many
            IPv6 addresses.
    """
    text = text.strip()
    span = _parse_span(text, include_ends=include_ends)
    if span is None:
        if _HOST_NAME.fullmatch(text):
            return None
        host, _, port = text.rpartition(":")
        reason = "a port has no place here" if host and port.isdecimal() else "it is no address"
        raise ConfigurationError(f"{text!r:.80}: {reason}: {EXPECTED_TEXT}")
    span = _to_ipv4(span)
    for network in _NETWORKS_WITHOUT_HOSTS:
        first, last = int(network.network_address), int(network.broadcast_address)
        if network.version == span.first.version and (
            span.first.number <= last and span.last.number >= first
        ):
            raise ConfigurationError(f"{text!r} has addresses of {network}, which no host has")
    if span.first.version == 6 and span.size > MAX_IPV6:
        raise ConfigurationError(
            f"{text!r} is {span.size:,} addresses: of IPv6 at most {MAX_IPV6} in a row are tried; "
            "name the hosts, or a network of /120 or smaller"
        )
    return span


def _parse_span(text: str, *, include_ends: bool) -> Span | None:
    """Return the addresses that a text means; None if it is no address, network or range."""
    address = _parse_address(text)
    if address is not None:
        return Span(address, address)
    if "/" in text:
        try:
            network = ipaddress.ip_network(text, strict=False)
        except ValueError as exc:
            raise ConfigurationError(f"{text!r:.80} is no network: {exc}") from exc
        return _hosts(network, include_ends=include_ends)
    first_text, dash, last_text = text.partition("-")
    first = _parse_address(first_text.strip()) if dash else None
    if first is None:
        return None
    last = _parse_address(last_text.strip())
    if last is None and first.version == 4 and re.fullmatch(r"\s*\d{1,3}\s*", last_text, re.ASCII):
        last = first._replace(number=(first.number & ~0xFF) + int(last_text))
        if int(last_text) > 0xFF:
            last = None
    if last is None or _network_kind(last) != _network_kind(first) or last.number < first.number:
        raise ConfigurationError(
            f"{text!r:.80} is no range: expected a first and a last address of one kind, such as "
            "192.168.0.10-192.168.0.20 or 192.168.0.10-20"
        )
    return Span(first, last)


def _parse_address(text: str) -> HostAddress | None:
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return None
    scope = (address.scope_id or "") if isinstance(address, ipaddress.IPv6Address) else ""
    if scope:
        _interface_index(scope)
    return HostAddress(address.version, int(address), scope)


def _hosts(network: ipaddress.IPv4Network | ipaddress.IPv6Network, *, include_ends: bool) -> Span:
    """Return a network's hosts: for IPv4 without the first address and the broadcast address."""
    first, last = int(network.network_address), int(network.broadcast_address)
    if network.version == 4 and last - first > 1 and not include_ends:
        first, last = first + 1, last - 1
    return Span(HostAddress(network.version, first), HostAddress(network.version, last))


def _to_ipv4(span: Span) -> Span:
    """Return a span with IPv4 addresses if they were written as IPv6; else the span itself."""
    if span.first.version == 6 and span.first.number >> 32 == span.last.number >> 32 == 0xFFFF:
        first, last = (HostAddress(4, address.number & 0xFFFFFFFF) for address in span)
        return Span(first, last)
    return span


def _interface_index(scope: str) -> int:
    """Return the number of a network interface, 0 for no interface."""
    if not scope or scope.isdecimal():
        return int(scope or 0)
    try:
        return socket.if_nametoindex(scope)
    except OSError as exc:
        raise ConfigurationError(f"there is no network interface {scope!r}") from exc


def _sort_key(address: HostAddress) -> tuple[int, str, int]:
    return address.version, address.scope, address.number


def _network_kind(address: HostAddress) -> tuple[int, str]:
    """Return version and scope; only addresses that share both can be in one span."""
    return address.version, address.scope


def parse_host_address(text: str) -> HostAddress:
    """Return the address in a name server's answer.

    Raises:
        ConfigurationError: no host has the address.
    """
    span = read_span(text)
    if span is None:
        raise ConfigurationError(f"{text!r} is no address")
    return span.first
