"""Test asking an address in every registered protocol: the tries, their order and the report."""

from __future__ import annotations

import dataclasses
import socket
from contextlib import aclosing
from typing import TYPE_CHECKING, Any

import pytest

from smartcam.doctor._inside import TracedAttempt, locate, no_session, try_ways
from smartcam.emulator import EmulatedCamera, EmulatedInSight
from smartcam.exceptions import ConnectFailedError
from smartcam.protocols import Protocol
from smartcam.registry import PROTOCOLS
from smartcam.settings import parse_address
from tests.doctor.doctorkit import errors, examined, finding_of
from tests.doctor.findkit import NETWORK, free_port
from tests.handmade import HOST, refusing
from tests.testing.acme_page import acme

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> Callable[[Protocol], None]:
    """Return a function that registers a protocol for this test."""

    def register(protocol: Protocol) -> None:
        monkeypatch.setitem(PROTOCOLS._registered, protocol.name, protocol)
        monkeypatch.setitem(PROTOCOLS._loaded, protocol.name, protocol)

    return register


async def tried(url: str, timeout: float = 2.0, **options: Any) -> list[TracedAttempt]:
    every = try_ways(parse_address(url), timeout=timeout, every_protocol=True, **options)
    async with aclosing(every) as found:
        return [trial async for trial in found]


async def test_camera_that_greets_is_asked_next_in_its_protocol() -> None:
    async with EmulatedInSight(host=HOST) as emulator:
        first, last = await tried(f"bvs://{HOST}:{emulator.port}")
    assert (first.address.protocol, first.is_other_protocol, first.answer) == ("bvs", False, None)
    assert last.answer is not None
    assert last.answer.url == f"insight://{HOST}:{emulator.port}?dialect=native"
    assert last.is_other_protocol


async def test_camera_of_a_plug_in_is_found_at_its_own_port(
    known: Callable[[Protocol], None],
) -> None:
    async with acme.AcmeCamera(host=f"{NETWORK}1") as emulator:
        known(dataclasses.replace(acme.ACME, default_port=emulator.port))
        found = await locate(f"{NETWORK}1", timeout=5.0)
        assert found == f"acme://{NETWORK}1:{emulator.port}?dialect=lines"
        *failed, last = await tried(f"{NETWORK}1")
    assert last.answer is not None
    assert {one.transport for one in failed} == {"tcp"}  # refused at once, before any UDP


async def test_camera_of_a_plug_in_is_found_at_another_port(
    known: Callable[[Protocol], None],
) -> None:
    known(acme.ACME)
    port = free_port()
    async with acme.AcmeCamera(host=f"{NETWORK}1", port=port):
        assert await locate(f"{NETWORK}1:{port}", timeout=2.0) == (
            f"acme://{NETWORK}1:{port}?dialect=lines"
        )


async def test_bvs_camera_is_found_at_the_address_of_another_protocol() -> None:
    async with EmulatedCamera(host=HOST) as emulator:
        (*_, last) = await tried(f"insight://{HOST}:{emulator.port}")
    assert last.answer is not None
    assert last.answer.url == emulator.url


async def test_broken_plug_in_costs_nothing(
    known: Callable[[Protocol], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PROTOCOLS._registered, "broken", object())
    async with EmulatedInSight(host=HOST) as emulator:
        assert (await tried(f"bvs://{HOST}:{emulator.port}"))[-1].answer is not None


async def test_most_telling_way_is_told_first(known: Callable[[Protocol], None]) -> None:
    known(dataclasses.replace(acme.ACME, default_port=free_port()))
    with refusing(socket.SOCK_STREAM):
        failed = await tried(f"{NETWORK}1", timeout=0.5)
    assert {one.address.protocol for one in failed} >= {"bvs", "insight", "acme", "pcic", "sr"}
    silent = [one for one in failed if one.transport == "udp"]
    heard = dataclasses.replace(silent[0], received=20)
    error = no_session(f"{NETWORK}1", heard.address, [*failed, heard])
    assert error.attempts[0] == str(heard)
    assert "over UDP" in error.attempts[0]


async def test_locate_says_why_there_is_none() -> None:
    with pytest.raises(ConnectFailedError) as caught:
        await locate(f"{NETWORK}1", timeout=0.5)
    assert str(caught.value).startswith(f"no session with {NETWORK}1: nothing listens at ")
    assert any(one.startswith("insight at port 23: ") for one in caught.value.attempts)


async def test_doctor_names_the_address_in_the_protocol_that_is_spoken() -> None:
    async with EmulatedInSight(host=HOST) as emulator:
        findings = await examined(f"bvs://{HOST}:{emulator.port}")
    refused, spoken, _ = [one for one in findings if one.check == "session"]
    url = f"insight://{HOST}:{emulator.port}?dialect=native"
    assert refused.severity == "error"
    assert url in refused.cure
    assert spoken.text.startswith("a camera answers by insight://, dialect native")
    assert finding_of(findings, "application").severity == "ok"
    assert errors(findings)[0][0] == "session"
