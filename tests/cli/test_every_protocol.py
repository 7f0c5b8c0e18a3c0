"""Commands at a host whose protocol is not given."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.cli.commandline import emulators, run
from tests.processes import Process

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="module")
def insight() -> Iterator[str]:
    """Give the host and port of an emulated In-Sight camera that is online."""
    with Process("smartcam-emulator", "--protocol", "insight") as emulator:
        url = emulator.read_until(b"\n").strip()
        run("start", url).done()
        yield url.partition("://")[2]
        emulator.send_signal(15)
        emulator.wait()


def test_probe_finds_the_protocol_and_prints_its_url(insight: str) -> None:
    out = run("probe", insight).done().out
    assert "insight at port " in out
    assert out.splitlines()[-1] == f"use: insight://{insight}?dialect=native"
    *tries, found = run("probe", insight, "--json").done().lines
    assert [one["protocol"] for one in tries] == ["bvs", "insight"]
    assert found["url"] == f"insight://{insight}?dialect=native"


def test_commands_take_a_bare_host_of_any_protocol(insight: str) -> None:
    assert f"insight://{insight}" in run("status", insight).done().out
    (result,) = run("trigger", insight, "--json").lines
    assert result["camera"] == insight


def test_doctor_goes_on_in_the_protocol_that_is_spoken(insight: str) -> None:
    outcome = run("doctor", insight, "--seconds", "0.1")
    assert "use this URL" in outcome.out
    assert "a camera answers by insight://" in outcome.out


def test_probe_tells_what_is_most_telling_first() -> None:
    from tests.cli.commandline import Peer

    with Peer(greeting=b"SSH-2.0-OpenSSH_9.6\r\n") as peer:
        outcome = run("probe", peer.host_and_port, "--timeout", "3")
    outcome.failed(3)
    told = outcome.err.partition(": no session with ")[2]
    assert told.partition("; ")[0].count("wrong magic number")


def test_bare_host_of_bvs_is_as_before(tmp_path_factory: pytest.TempPathFactory) -> None:
    with emulators(tmp_path_factory.mktemp("bare"), ()) as (url,):
        host = url.partition("://")[2].partition("?")[0]
        assert (
            "Hello World"
            in run("trigger", host, "--application", "21", "--interpret-as", "text: string[20]")
            .done()
            .out
        )
