"""The suite for pytest: one test for each check; subclass it, or run it from the shell."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import pytest

from smartcam.conformance._pytest_options import FINDING_PROPERTY
from smartcam.conformance.client._checks import CHECKS, ClientCheck, Grade
from smartcam.conformance.client._report import judge
from smartcam.conformance.client._runs import ClientRun, run_scene
from smartcam.conformance.client._tasks import Client, CommandClient, FunctionClient
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import BVS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Sequence

    from smartcam.conformance.client._tasks import Task

MAX_SECONDS = 3600
"""Largest number of seconds for a task."""

_RUNS: pytest.StashKey[dict[tuple[type, str, str, str], ClientRun]] = pytest.StashKey()


class ClientOptions(NamedTuple):
    """The options that describe the client."""

    command: str | None = None  # ``--client-command``, None if it is not given
    dialects: tuple[str, ...] | None = None  # ``--client-dialect``, names with commas between them
    transports: tuple[str, ...] | None = None  # ``--client-transport``, with commas
    timeout: float | None = None  # ``--client-timeout``, seconds


def read_options(config: Any) -> ClientOptions:
    """Read the options from pytest's ``config``; without the plugin all are None.

    Raises:
        pytest.UsageError: a value is not valid.
    """
    timeout = config.getoption("--client-timeout", default=None)
    if timeout is not None and not 0 < timeout <= MAX_SECONDS:
        raise pytest.UsageError(
            f"--client-timeout: {timeout:g} s; more than 0 and at most {MAX_SECONDS} s are expected"
        )
    return ClientOptions(
        config.getoption("--client-command", default=None),
        _names(config, "--client-dialect", tuple(BVS.dialects)),
        _names(config, "--client-transport", ("tcp", "udp")),
        timeout,
    )


def _names(config: Any, option: str, known: Sequence[str]) -> tuple[str, ...] | None:
    text: str | None = config.getoption(option, default=None)
    if text is None:
        return None
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in known:
            raise pytest.UsageError(f"{option}: {name!r}; known are {', '.join(known)}")
    return names or None


class ClientConformance:
    """Tests of a client: each check in each dialect over each transport that the client supports.

    Subclass it and set how to run the client: a :attr:`command`, or override :meth:`perform`.
    The tests are synchronous and need no other plugin. A breach of a rule with grade "should" does
    not fail its test; the plugin ``smartcam`` shows it at the end.

    Attributes:
        command: program and arguments, in which ``{task}``, ``{host}``, ``{port}``, ``{url}``,
            ``{transport}`` and ``{dialect}`` are replaced; None for ``--client-command``.
        dialects: names of the dialects that the client speaks.
        transports: names of the transports that the client can use.
        timeout: seconds for a task. A client's own timeouts must end within it.
    """

    command: ClassVar[str | Sequence[str] | None] = None
    dialects: ClassVar[tuple[str, ...]] = ("handbook",)
    transports: ClassVar[tuple[str, ...]] = ("tcp",)
    timeout: ClassVar[float] = 30.0

    def perform(self, task: Task) -> Iterable[bytes] | Awaitable[Iterable[bytes]]:
        """Do a task; override it for a client in Python, plain or asynchronous.

        It runs in a thread of its own; an asynchronous method gets an event loop there.

        Args:
            task: the task.

        Returns:
            The data of the results, in order, each without the application's id.

        Raises:
            NotImplementedError: the client does not support the task; its tests are skipped.
            Exception: any error that means that the client has failed.
        """
        raise NotImplementedError

    @classmethod
    def pytest_generate_tests(cls, metafunc: pytest.Metafunc) -> None:
        """Make a test of each check for each dialect and transport that it applies to."""
        if "client_case" not in metafunc.fixturenames:
            return
        options = read_options(metafunc.config)
        cases = [
            pytest.param((check, dialect, transport), id=f"{dialect}-{transport}-{check.name}")
            for dialect in options.dialects or cls.dialects
            for transport in options.transports or cls.transports
            for check in CHECKS
            if check.applies(dialect, transport)
        ]
        metafunc.parametrize("client_case", cases)

    def client(self, config: pytest.Config) -> Client | None:
        """Return the client to judge, None without one."""
        if type(self).perform is not ClientConformance.perform:
            return FunctionClient(self.perform)
        command = self.command or read_options(config).command
        return None if command is None else CommandClient(command)

    def test_client(
        self,
        client_case: tuple[ClientCheck, str, str],
        request: pytest.FixtureRequest,
        record_property: Callable[[str, object], None],
    ) -> None:
        """Run the check's task with the client, and judge the run."""
        check, dialect, transport = client_case
        run = self._run(check, dialect, transport, request.config)
        if not run.outcome.supported:
            reason = f": {run.outcome.output}" if run.outcome.output else ""
            pytest.skip(f'the client cannot do the task "{run.task}"{reason}')
        finding = judge(check, run)
        if finding is None:
            return
        record_property(FINDING_PROPERTY, finding.as_json())
        if check.grade is Grade.MUST:
            pytest.fail(str(finding), pytrace=False)

    def _run(
        self, check: ClientCheck, dialect: str, transport: str, config: pytest.Config
    ) -> ClientRun:
        """Return a run of the check's scene; several checks share one run."""
        runs = config.stash.setdefault(_RUNS, {})
        key = (type(self), check.scene.name, dialect, transport)
        if key not in runs:
            runs[key] = self._perform(check, dialect, transport, config)
        return runs[key]

    def _perform(
        self, check: ClientCheck, dialect: str, transport: str, config: pytest.Config
    ) -> ClientRun:
        timeout = read_options(config).timeout or self.timeout
        try:
            client = self.client(config)
            if client is None:
                pytest.skip(
                    "no client: pytest --pyargs smartcam.conformance.client --client-command "
                    '"./mine {host} {port} {task}"'
                )
            return asyncio.run(
                run_scene(
                    client, check.scene, dialect=dialect, transport=transport, timeout=timeout
                )
            )
        except ConfigurationError as exc:
            pytest.fail(str(exc), pytrace=False)
