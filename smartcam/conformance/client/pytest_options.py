"""What the pytest plugin has for judging clients: options, and a section of the report.

It is light: the plugin imports it in every run of pytest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["PROPERTY", "ClientOptions", "add_options", "read_options", "terminal_summary"]

PROPERTY = "smartcam-client-finding"
"""Name of a test report's property that holds a finding: reports pass from process to process."""

TRANSPORTS = ("tcp", "udp")

MAX_SECONDS = 3600
"""Seconds that a task may be given at most."""


class ClientOptions(NamedTuple):
    """What the options say of the client.

    Attributes:
        command: ``--client-command``, None where it is not given.
        dialects: ``--client-dialect``, names with commas between them.
        transports: ``--client-transport``, the same.
        timeout: ``--client-timeout``, seconds.
    """

    command: str | None = None
    dialects: tuple[str, ...] | None = None
    transports: tuple[str, ...] | None = None
    timeout: float | None = None


OPTIONS: dict[str, tuple[type, str]] = {
    "command": (
        str,
        "The client to judge: a command with {task}, and {url} or {host} and {port}. It does the "
        "task and prints each result's bytes as hex or JSON, one line each; exit code 0: done, 77: "
        "it has no such task, anything else: failed.",
    ),
    "dialect": (str, "What the client speaks, with commas between several; default handbook."),
    "transport": (str, "tcp, udp, or both with a comma between them; default tcp."),
    "timeout": (float, "Seconds that a task may take; default 30."),
}
"""Type and help text of each option, by its name behind ``--client-``."""


def add_options(parser: Any) -> None:
    """Register the options with pytest's ``parser`` (``pytest_addoption``)."""
    group = parser.getgroup("smartcam-client", "smartcam: how good is a client?")
    for name, (kind, text) in OPTIONS.items():
        group.addoption(
            f"--client-{name}", type=kind, default=None, metavar=name.upper(), help=text
        )


def read_options(config: Any) -> ClientOptions:
    """Return what pytest's ``config`` has of the options; none is given where no plugin has them.

    Raises:
        pytest.UsageError: a value cannot be.
    """
    from smartcam.protocols.bvs import BVS

    timeout = config.getoption("--client-timeout", default=None)
    if timeout is not None and not 0 < timeout <= MAX_SECONDS:
        raise _usage_error(
            f"--client-timeout: {timeout:g} s; more than 0 and at most {MAX_SECONDS} s are expected"
        )
    return ClientOptions(
        config.getoption("--client-command", default=None),
        _names(config, "--client-dialect", tuple(BVS.dialects)),
        _names(config, "--client-transport", TRANSPORTS),
        timeout,
    )


def terminal_summary(reporter: Any) -> None:
    """Write what was found of clients into pytest's report; nothing where nothing was.

    Args:
        reporter: pytest's ``terminalreporter``.
    """
    found = [
        value
        for reports in reporter.stats.values()
        for one in reports
        if getattr(one, "when", None) == "call"
        for name, value in one.user_properties
        if name == PROPERTY
    ]
    if found:
        from smartcam.conformance.client.report import ClientFinding, write_findings

        write_findings(reporter, [ClientFinding.from_json(value) for value in found])


def _names(config: Any, option: str, known: Sequence[str]) -> tuple[str, ...] | None:
    text: str | None = config.getoption(option, default=None)
    if text is None:
        return None
    found = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in found:
        if name not in known:
            raise _usage_error(f"{option}: {name!r}; known are {', '.join(known)}")
    return found or None


def _usage_error(text: str) -> Exception:
    import pytest

    return pytest.UsageError(text)
