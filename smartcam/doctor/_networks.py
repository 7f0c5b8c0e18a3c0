"""Parse a text as addresses: a network, a range, one address, a host's name."""

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

_NAME = re.compile(r"(?=.*[A-Za-z])\w(?:[\w.-]{0,251}\w)?", re.ASCII)

_NO_HOST = tuple(
    ipaddress.ip_network(network) for network in ("0.0.0.0/8", "224.0.0.0/3", "::/128", "ff00::/8")
)
"""Addresses that no host has: unspecified, multicast and broadcast ones."""

EXPECTED = (
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
        plain = str(ipaddress.IPv6Address(self.number))
        return socket.AF_INET6, (plain, port, 0, _interface(self.scope))


class Span(NamedTuple):
    """Addresses in a row, both ends included."""

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
        key = _place
        for span in sorted(spans, key=lambda span: (*key(span.first), span.last.number)):
            before = self._spans[-1] if self._spans else None
            if (
                before is not None
                and key(before.last)[:2] == key(span.first)[:2]
                and span.first.number <= before.last.number + 1
            ):
                self._spans[-1] = Span(before.first, max(before.last, span.last))
            else:
                self._spans.append(span)
        self._firsts = [_place(span.first) for span in self._spans]

    def __len__(self) -> int:
        """Return the number of addresses."""
        return sum(span.size for span in self._spans)

    def __contains__(self, address: HostAddress) -> bool:
        """Return True if an address is in the set."""
        nth = bisect.bisect_right(self._firsts, _place(address)) - 1
        if nth < 0:
            return False
        first, last = self._spans[nth]
        same = _place(first)[:2] == _place(address)[:2]
        return same and first.number <= address.number <= last.number

    def without(self, others: AddressSet) -> AddressSet:
        """Return the addresses that are not in another set."""
        left: list[Span] = []
        for first, last in self._spans:
            for away in others._spans:
                if _place(away.first)[:2] != _place(first)[:2] or away.last.number < first.number:
                    continue
                if away.first.number > last.number:
                    break
                if away.first.number > first.number:
                    left.append(Span(first, first._replace(number=away.first.number - 1)))
                first = first._replace(number=away.last.number + 1)
                if first.number > last.number:
                    break
            if first.number <= last.number:
                left.append(Span(first, last))
        return AddressSet(left)

    def __iter__(self) -> Iterator[HostAddress]:
        """Yield each address."""
        for first, last in self._spans:
            for number in range(first.number, last.number + 1):
                yield first._replace(number=number)


def read_span(text: str, *, whole: bool = False) -> Span | None:
    """Return the addresses that a text means; None for a name, which has to be looked up.

    ``whole``: include an IPv4 network's first and last address, which are no hosts in it, but may
    be hosts in a larger one.

    Raises:
        ConfigurationError: the text means no address, or no host's, or an IPv6 network that is too
            large.
    """
    text = text.strip()
    span = _read(text, whole=whole)
    if span is None:
        if _NAME.fullmatch(text):
            return None
        host, _, port = text.rpartition(":")
        why = "a port has no place here" if host and port.isdecimal() else "it is no address"
        raise ConfigurationError(f"{text!r:.80}: {why}: {EXPECTED}")
    span = _mapped(span)
    for network in _NO_HOST:
        begin, end = int(network.network_address), int(network.broadcast_address)
        if network.version == span.first.version and (
            span.first.number <= end and span.last.number >= begin
        ):
            raise ConfigurationError(f"{text!r} has addresses of {network}, which no host has")
    if span.first.version == 6 and span.size > MAX_IPV6:
        raise ConfigurationError(
            f"{text!r} is {span.size:,} addresses: of IPv6 at most {MAX_IPV6} in a row are tried; "
            "name the hosts, or a network of /120 or smaller"
        )
    return span


def _read(text: str, *, whole: bool) -> Span | None:
    """Return the addresses that a text means; None if it is no address, network or range."""
    address = _address(text)
    if address is not None:
        return Span(address, address)
    if "/" in text:
        try:
            network = ipaddress.ip_network(text, strict=False)
        except ValueError as exc:
            raise ConfigurationError(f"{text!r:.80} is no network: {exc}") from exc
        return _hosts(network, whole=whole)
    left, dash, right = text.partition("-")
    first = _address(left.strip()) if dash else None
    if first is None:
        return None
    last = _address(right.strip())
    if last is None and first.version == 4 and re.fullmatch(r"\s*\d{1,3}\s*", right, re.ASCII):
        last = first._replace(number=(first.number & ~0xFF) + int(right))
        if int(right) > 0xFF:
            last = None
    if last is None or _place(last)[:2] != _place(first)[:2] or last.number < first.number:
        raise ConfigurationError(
            f"{text!r:.80} is no range: expected a first and a last address of one kind, such as "
            "192.168.0.10-192.168.0.20 or 192.168.0.10-20"
        )
    return Span(first, last)


def _address(text: str) -> HostAddress | None:
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return None
    scope = (address.scope_id or "") if isinstance(address, ipaddress.IPv6Address) else ""
    if scope:
        _interface(scope)
    return HostAddress(address.version, int(address), scope)


def _hosts(network: ipaddress.IPv4Network | ipaddress.IPv6Network, *, whole: bool) -> Span:
    """Return a network's hosts: for IPv4 without the first address and the broadcast address."""
    first, last = int(network.network_address), int(network.broadcast_address)
    if network.version == 4 and last - first > 1 and not whole:
        first, last = first + 1, last - 1
    return Span(HostAddress(network.version, first), HostAddress(network.version, last))


def _mapped(span: Span) -> Span:
    """Return IPv4 addresses in place of those written as IPv6; others unchanged."""
    if span.first.version == 6 and span.first.number >> 32 == span.last.number >> 32 == 0xFFFF:
        first, last = (HostAddress(4, address.number & 0xFFFFFFFF) for address in span)
        return Span(first, last)
    return span


def _interface(scope: str) -> int:
    """Return an interface's number, 0 for none."""
    if not scope or scope.isdecimal():
        return int(scope or 0)
    try:
        return socket.if_nametoindex(scope)
    except OSError as exc:
        raise ConfigurationError(f"there is no network interface {scope!r}") from exc


def _place(address: HostAddress) -> tuple[int, str, int]:
    return address.version, address.scope, address.number


def address_of(text: str) -> HostAddress:
    """Return the address in a name server's answer.

    Raises:
        ConfigurationError: the address is no host's.
    """
    span = read_span(text)
    if span is None:
        raise ConfigurationError(f"{text!r} is no address")
    return span.first
