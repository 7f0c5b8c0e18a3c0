"""Whatever of the package has a port of its own is known, and proved somewhere."""

from __future__ import annotations

import ast
from pathlib import Path

import smartcam

ROOT = Path(smartcam.__file__).parent

CALLS = {
    "create_server",
    "start_server",
    "start_unix_server",
    "create_unix_server",
    "create_datagram_endpoint",
    "listening_socket",
    "open_listening",
    "bind",
    "TCPSite",
    "SockSite",
    "UnixSite",
    "run_app",
    "ThreadingHTTPServer",
    "HTTPServer",
    "TCPServer",
    "UDPServer",
}
"""Calls that make a port, or wait at one."""

KNOWN = {
    # connections: rows of tests.accepting.servers
    "_accepting.py": {"create_server"},
    "emulator/_port.py": {"bind"},
    "web/_site.py": {"listening_socket"},
    "gateway/_gateway.py": {"listening_socket"},
    "frames/_streaming/rtsp/server.py": {"listening_socket"},
    "testing/proxy/_relay.py": {"bind"},
    # datagrams, for which there are tests in test_datagrams
    "emulator/_links.py": {"create_datagram_endpoint"},
    "frames/_streaming/rtp/driver.py": {"open_listening"},
    "frames/_streaming/rtp/sockets.py": {"bind", "open_listening"},
    "frames/_streaming/rtsp/delivery.py": {"bind", "create_datagram_endpoint"},
    "frames/_gige/stream.py": {"bind"},
    "frames/_gige/discovery.py": {"create_datagram_endpoint"},
    "frames/_gige/event_channel.py": {"create_datagram_endpoint"},
    "frames/_gige/force_address.py": {"create_datagram_endpoint"},
    # connected to one peer: the system drops what others send
    "frames/_gige/control.py": {"create_datagram_endpoint"},
    "_client/link.py": {"create_datagram_endpoint"},
    # a port that is looked for and let go again
    "_zenoh.py": {"bind"},
    # arguments, to the names of a function's parameters
    "_argument_checks.py": {"bind"},
}
"""The modules with such calls."""


def calls_of(path: Path) -> set[str]:
    text = path.read_text(encoding="utf-8")
    if not any(f"{name}(" in text for name in CALLS):
        return set()
    tree = ast.parse(text)
    called = [one.func for one in ast.walk(tree) if isinstance(one, ast.Call)]
    names = {
        one.attr if isinstance(one, ast.Attribute) else one.id
        for one in called
        if isinstance(one, ast.Attribute | ast.Name)
    }
    return names & CALLS


def listens(path: Path) -> bool:
    """Return whether a module accepts on a socket by itself."""
    text = path.read_text(encoding="utf-8")
    return ".accept(" in text or "sock_accept(" in text or "asyncio.Server(" in text


def test_every_port_of_the_package_is_known() -> None:
    found = {
        path.relative_to(ROOT).as_posix(): calls
        for path in ROOT.rglob("*.py")
        if (calls := calls_of(path))
    }
    assert found == KNOWN


def test_nobody_accepts_but_the_acceptor() -> None:
    found = {path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.py") if listens(path)}
    assert found == {"_accepting.py"}
