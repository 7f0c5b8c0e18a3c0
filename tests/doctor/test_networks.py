"""Test texts that mean addresses, and sets of addresses."""

from __future__ import annotations

import ipaddress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.doctor._networks import AddressSet, HostAddress, Span, read_span
from smartcam.exceptions import ConfigurationError


def texts(*given: str) -> list[str]:
    """Return the addresses that texts mean, as text."""
    spans = [read_span(one) for one in given]
    return [str(one) for one in AddressSet([one for one in spans if one is not None])]


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("192.168.0.7", ["192.168.0.7"]),
        (" 192.168.0.0/30 ", ["192.168.0.1", "192.168.0.2"]),
        ("192.168.0.2/30", ["192.168.0.1", "192.168.0.2"]),
        ("192.168.0.4/31", ["192.168.0.4", "192.168.0.5"]),
        ("192.168.0.4/32", ["192.168.0.4"]),
        ("10.0.0.254-10.0.1.1", ["10.0.0.254", "10.0.0.255", "10.0.1.0", "10.0.1.1"]),
        ("192.168.0.9-11", ["192.168.0.9", "192.168.0.10", "192.168.0.11"]),
        ("fd00::8", ["fd00::8"]),
        ("fd00::/127", ["fd00::", "fd00::1"]),
        ("fd00::1-fd00::2", ["fd00::1", "fd00::2"]),
        ("::ffff:192.168.0.7", ["192.168.0.7"]),
        ("fe80::1%7", ["fe80::1%7"]),
    ],
)
def test_text_means_addresses(text: str, meant: list[str]) -> None:
    assert texts(text) == meant


@pytest.mark.parametrize("name", ["localhost", "camera-3.line1.example", "cam_7", "7cam"])
def test_name_has_to_be_looked_up(name: str) -> None:
    assert read_span(name) is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no address"),
        ("192.168.0.300", "is no address"),
        ("192.168.0", "is no address"),
        ("3232235521", "is no address"),
        ("bvs://192.168.0.10", "is no network"),
        ("cam 3", "is no address"),
        ("-cam", "is no address"),
        ("192.168.0.0/33", "is no network"),
        ("192.168.0.10-5", "is no range"),
        ("192.168.0.10-256", "is no range"),
        ("192.168.0.10-fd00::1", "is no range"),
        ("192.168.0.10-cam", "is no range"),
        ("fd00::/64", "of IPv6 at most 256"),
        ("fd00::-fd00::ffff", "of IPv6 at most 256"),
        ("224.0.0.1", "which no host has"),
        ("255.255.255.255", "which no host has"),
        ("0.0.0.0", "which no host has"),  # noqa: S104 - nothing is bound to it
        ("0.0.0.0/0", "which no host has"),
        ("223.0.0.0-225.0.0.0", "which no host has"),
        ("ff02::1", "which no host has"),
        ("::", "which no host has"),
        ("fe80::1%no-such-interface", "no network interface"),
    ],
)
def test_text_that_means_none_is_refused(text: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        read_span(text)


@pytest.mark.parametrize(
    ("address", "place"),
    [("192.168.0.7", ("192.168.0.7", 23)), ("fe80::1%7", ("fe80::1", 23, 0, 7))],
)
def test_socket_gets_the_address(address: str, place: tuple[object, ...]) -> None:
    span = read_span(address)
    assert span is not None
    assert span.first.sockaddr(23)[1] == place


PLACES = st.tuples(st.sampled_from([4, 6]), st.integers(1, 30), st.integers(0, 9))


BASE = {4: int(ipaddress.ip_address("10.0.0.0")), 6: 0xFD << 120}


def spans_of(places: list[tuple[int, int, int]]) -> tuple[list[Span], set[HostAddress]]:
    """Return spans, and the set of their addresses."""
    spans = [
        Span(*(HostAddress(kind, BASE[kind] + one) for one in (first, first + extra)))
        for kind, first, extra in places
    ]
    return spans, {
        HostAddress(kind, BASE[kind] + first + nth)
        for kind, first, extra in places
        for nth in range(extra + 1)
    }


@given(st.lists(PLACES, max_size=8), st.lists(PLACES, max_size=8))
def test_set_has_each_address_once_and_in_order(
    places: list[tuple[int, int, int]], others: list[tuple[int, int, int]]
) -> None:
    (spans, expected), (more_spans, excluded) = spans_of(places), spans_of(others)
    found = AddressSet(spans)
    assert list(found) == sorted(expected)
    assert len(found) == len(expected)
    for kind in (4, 6):
        for number in range(45):
            address = HostAddress(kind, BASE[kind] + number)
            assert (address in found) == (address in expected)
    left = found.without(AddressSet(more_spans))
    assert list(left) == sorted(expected - excluded)
    assert len(left) == len(expected - excluded)
