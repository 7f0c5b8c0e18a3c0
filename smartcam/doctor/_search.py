"""Find cameras: search networks for hosts with open ports that cameras use.

A search opens ports and sends nothing; it reads bytes that a port sends by itself. If the caller
allows it, the search also speaks to the found cameras, like ``smartcam probe``.
"""

from __future__ import annotations

import asyncio
import collections
import dataclasses
import socket
from contextlib import aclosing
from typing import TYPE_CHECKING

from smartcam._arguments import (
    check_flag,
    check_integer,
    check_iterable,
    check_number,
    check_text,
    excerpt,
)
from smartcam.doctor._found import (
    check_consent,
    choose_ports,
    describe_port,
    is_decided,
    may_serve_one_client,
    tcp_protocols,
)
from smartcam.doctor._networks import AddressSet, Span, parse_host_address, read_span
from smartcam.doctor._opening import NO_SOCKET_ERRORS, open_port
from smartcam.doctor._probing import try_ways
from smartcam.exceptions import ConfigurationError
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.doctor._found import FoundPort
    from smartcam.doctor._networks import HostAddress

DEFAULT_MAX_ADDRESSES = 65_536
"""Largest number of addresses of one search by default."""

MAX_ADDRESSES = 1 << 24
"""Largest number of addresses of one search."""

MAX_NETWORK_TEXT = 300
"""Length of the longest text of a network; a host's name has at most 253 characters."""

MAX_OPEN_CONNECTIONS = 1_000
"""Largest number of connections at a time."""

MAX_OPENINGS_PER_SECOND = 10_000.0
"""Largest number of connections opened in a second."""

MAX_SECONDS = 60.0
"""Largest number of seconds for opening one port."""

ASK_TIMEOUT = 10.0
"""Seconds to ask one camera in all possible protocols together."""

MAX_ASKED_AT_ONCE = 16
"""Number of cameras that are asked at the same time."""

NAME_TIMEOUT = 5.0
"""Seconds for looking up a host's name."""

SOCKET_RETRY_DELAY = 0.05
"""Seconds until the next attempt if the system has no socket left."""


async def find(
    *networks: str,
    ports: Iterable[int] = (),
    protocols: Iterable[str] | None = None,
    exclude: Iterable[str] = (),
    may_disturb: bool = False,
    ask: bool = False,
    rate: float = 100.0,
    at_once: int = 64,
    timeout: float = 1.0,
    max_addresses: int = DEFAULT_MAX_ADDRESSES,
) -> list[FoundPort]:
    """Return the open ports of networks where cameras may listen, sorted by address.

    The protocols' ports are opened, one opening after the other at ``rate``; nothing is sent.
    Cameras that use UDP cannot be found in this way. A camera that serves one client may be
    disturbed by a connection that sends nothing; no document rules this out. Exclude such cameras
    by ``exclude``.

    Args:
        networks: each ``192.168.0.0/24``, ``192.168.0.10-20``, an address or a host's name. An IPv6
            network has at most 256 addresses.
        ports: further ports to open, which may serve any of the protocols.
        protocols: names of the protocols to look for; default: all that are known.
        exclude: addresses of working cameras that the search does not touch, in the form of
            ``networks``.
        may_disturb: allows asking cameras that serve one client, such as those of ``bvs``.
        ask: also ask the cameras that were found; this takes a camera that serves one client from
            its client.
        rate: largest number of openings per second.
        at_once: largest number of connections at a time.
        timeout: seconds to open a port, and again to read bytes that the port sends by itself.
        max_addresses: number of addresses above which a search is refused.

    Raises:
        ConfigurationError: a network, a number or a protocol cannot work, there are too many
            addresses, a name does not resolve, the system has no socket left, or consent is
            missing. Nothing was opened, except if the system ran out of sockets.

    Cancellation: every connection is closed.
    """
    search = CameraSearch(
        networks,
        ports=ports,
        protocols=protocols,
        exclude=exclude,
        may_disturb=may_disturb,
        ask=ask,
        rate=rate,
        at_once=at_once,
        timeout=timeout,
        max_addresses=max_addresses,
    )
    await search.run()
    return search.results()


class CameraSearch:
    """A search. Its results remain after its end, even if it failed. Arguments as in :func:`find`.

    Attributes:
        tried: number of ports that were tried.
        total: number of ports to try, once names are looked up.
        counts: number of tried ports by outcome.
        failure: reason of the first failure of this machine.
        excluded: addresses that were not touched, each with the text that named it.
        has_begun: whether the search has begun to try ports.
    """

    def __init__(
        self,
        networks: Sequence[str],
        *,
        ports: Iterable[int] = (),
        protocols: Iterable[str] | None = None,
        exclude: Iterable[str] = (),
        may_disturb: bool = False,
        ask: bool = False,
        rate: float = 100.0,
        at_once: int = 64,
        timeout: float = 1.0,
        max_addresses: int = DEFAULT_MAX_ADDRESSES,
    ) -> None:
        rate = check_number(rate, "rate", 0, MAX_OPENINGS_PER_SECOND, "find", exclusive=True)
        at_once = check_integer(at_once, "at_once", 1, MAX_OPEN_CONNECTIONS, "find")
        timeout = check_number(timeout, "timeout", 0, MAX_SECONDS, "find", exclusive=True)
        max_addresses = check_integer(max_addresses, "max_addresses", 1, MAX_ADDRESSES, "find")
        may_disturb = check_flag(may_disturb, "may_disturb", "find")
        ask = check_flag(ask, "ask", "find")
        if not networks or not all(isinstance(text, str) for text in networks):
            raise ConfigurationError(
                "find: expected one network or several, each a text of its own; got "
                f"{excerpt(networks)}"
            )
        networks = [check_text(text, "network", "find", most=MAX_NETWORK_TEXT) for text in networks]
        exclude = [
            check_text(text, "exclude", "find", most=MAX_NETWORK_TEXT)
            for text in check_iterable(exclude, "exclude", "texts of addresses", "find")
        ]
        self._networks = [(text, read_span(text)) for text in networks]
        self._excluded = [(text, read_span(text, include_ends=True)) for text in exclude]
        self._ports = choose_ports(ports, protocols)
        if ask and not may_disturb:
            check_consent(self._ports)
        self._wants_answers = ask
        self._interval = 1.0 / rate
        self._at_once = at_once
        self._timeout = timeout
        self._max_addresses = max_addresses
        _check_network_sizes(self._networks, max_addresses)
        self._ports_found: dict[tuple[HostAddress, int], FoundPort] = {}
        self._open_count = 0
        self.tried = 0
        self.total = 0
        self.counts: collections.Counter[str] = collections.Counter()
        self.failure = ""
        self.excluded: dict[str, str] = {}
        self.has_begun = False

    @property
    def exclusive(self) -> list[str]:
        """Names of protocols of found cameras that were not asked, since they serve one client."""
        if self._wants_answers:
            return []
        names = {name for port in self._ports_found.values() for name in port.protocols}
        known = tcp_protocols()
        return sorted(name for name in names if may_serve_one_client(known[name]))

    def results(self) -> list[FoundPort]:
        """Return the ports found so far, sorted by address."""
        return [self._ports_found[key] for key in sorted(self._ports_found)]

    async def run(self) -> None:
        """Search.

        Raises:
            ConfigurationError: a name does not resolve, there are too many addresses, or the system
                has no socket left.

        Cancellation: every connection is closed; the results stay.
        """
        addresses = AddressSet(
            [span for text, parsed in self._networks for span in await _resolve_spans(text, parsed)]
        )
        excluded = [
            (text, span)
            for text, parsed in self._excluded
            for span in await _resolve_spans(text, parsed)
        ]
        _check_count(len(addresses), self._max_addresses)
        for text, span in excluded:
            if span.size == 1 and span.first in addresses:
                self.excluded[str(span.first)] = text
        addresses = addresses.without(AddressSet(span for _, span in excluded))
        self.total = len(addresses) * len(self._ports)
        self.has_begun = True
        loop = asyncio.get_running_loop()
        free_connections, next_opening = asyncio.Semaphore(self._at_once), loop.time()
        try:
            async with asyncio.TaskGroup() as group:
                for address in addresses:
                    for port in self._ports:
                        await free_connections.acquire()
                        await asyncio.sleep(max(0.0, next_opening - loop.time()))
                        next_opening = max(next_opening, loop.time()) + self._interval
                        task = group.create_task(
                            self._try_port(address, port), name=f"smartcam.find[{address}:{port}]"
                        )
                        task.add_done_callback(lambda _: free_connections.release())
        except ExceptionGroup as error_group:
            configuration_errors, other_errors = error_group.split(ConfigurationError)
            if configuration_errors is None or other_errors is not None:
                raise
            raise configuration_errors.exceptions[0] from None
        if self._wants_answers:
            await self._ask_all()

    async def _try_port(self, address: HostAddress, port: int) -> None:
        protocols = self._ports[port]
        sock = await self._new_socket(address)
        self._open_count += 1
        try:
            opened = await open_port(
                sock,
                address,
                port,
                timeout=self._timeout,
                is_enough=lambda received: is_decided(received, protocols),
            )
        finally:
            self._open_count -= 1
        self.tried += 1
        self.counts[opened.outcome] += 1
        self.failure = self.failure or opened.failure
        if opened.outcome == "open":
            self._ports_found[address, port] = describe_port(str(address), port, opened, protocols)

    async def _new_socket(self, address: HostAddress) -> socket.socket:
        """Return a new socket; wait until the system has one left."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + 4 * self._timeout
        while True:
            try:
                return socket.socket(address.sockaddr(0)[0], socket.SOCK_STREAM)
            except OSError as exc:
                if exc.errno not in NO_SOCKET_ERRORS:
                    raise ConfigurationError(f"find: {address}: {exc.strerror}") from exc
                if not self._open_count or loop.time() > deadline:
                    raise ConfigurationError(
                        f"find: this process has no socket left ({exc.strerror}), with "
                        f"{self._open_count} of the search's own open: close others, or allow more "
                        "(ulimit -n)"
                    ) from exc
            await asyncio.sleep(SOCKET_RETRY_DELAY)

    async def _ask_all(self) -> None:
        free_requests = asyncio.Semaphore(MAX_ASKED_AT_ONCE)

        async def ask(key: tuple[HostAddress, int]) -> None:
            async with free_requests:
                self._ports_found[key] = await ask_port(self._ports_found[key])

        async with asyncio.TaskGroup() as group:
            for key, port in sorted(self._ports_found.items()):
                if port.protocols:
                    group.create_task(ask(key), name=f"smartcam.find[{port.host}:{port.port}].ask")


# ---------------------------------------------------------------------- addresses


async def _resolve_spans(text: str, span: Span | None) -> list[Span]:
    """Return the addresses that a text means: ``span``, or if it is None, those of the name."""
    if span is not None:
        return [span]
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(NAME_TIMEOUT):
            resolved = await loop.getaddrinfo(text.strip(), None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as exc:
        reason = (exc.strerror if isinstance(exc, OSError) else str(exc)) or (
            f"no name server answers within {NAME_TIMEOUT:g} s"
        )
        raise ConfigurationError(f"find: the name {text!r} does not resolve: {reason}") from exc
    addresses = {parse_host_address(str(entry[4][0])) for entry in resolved}
    return [Span(address, address) for address in sorted(addresses)]


def _check_network_sizes(networks: Iterable[tuple[str, Span | None]], max_count: int) -> None:
    _check_count(len(AddressSet(span for _, span in networks if span is not None)), max_count)


def _check_count(count: int, max_count: int) -> None:
    if count > max_count:
        raise ConfigurationError(
            f"find: {count:,} addresses are more than {max_count:,}: name smaller networks, or "
            f"allow them by max_addresses={count} (--max-addresses {count}), {MAX_ADDRESSES:,} at "
            "most"
        )


# ---------------------------------------------------------------------- asking


async def ask_port(port: FoundPort) -> FoundPort:
    """Ask a found camera in each possible protocol; return the port with the answer or refusal."""
    failed: list[str] = []
    for url in port.urls:
        async with aclosing(try_ways(parse_address(url), timeout=ASK_TIMEOUT)) as attempts:
            async for attempt in attempts:
                if attempt.answer is not None:
                    return dataclasses.replace(port, answer=attempt.answer)
                failed.append(str(attempt))
    return dataclasses.replace(port, refusal="; ".join(failed))
