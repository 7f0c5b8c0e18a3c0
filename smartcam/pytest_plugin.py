"""The pytest plugin ``smartcam``: emulated cameras as fixtures, for tests of any client.

::

    def test_driver(emulated_camera):
        my_driver.run(emulated_camera.host, emulated_camera.port)
        emulated_camera.log.expect("Connect", "Trigger", "Disconnect")


    @pytest.mark.smartcam(application=7, interpret_as="localizations", transport="udp")
    async def test_robot(camera):
        assert len((await camera.trigger()).value) == 7

It is loaded with every run of pytest where smartcam is installed, so nothing but pytest is imported
here before a fixture is used.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator

    from smartcam.camera import Camera
    from smartcam.emulator import Scenario
    from smartcam.testing import ThreadedCamera, ThreadedFleet

T = TypeVar("T")

__all__ = ["camera", "emulated_camera", "emulated_fleet"]

PROTOCOL = "bvs"
"""The default protocol of the emulated camera."""

FORWARDED_OPTIONS = frozenset({"protocol", "manual_clock"})
"""Options of :class:`ThreadedCamera` itself, which the fixture passes on."""

MARKER_OPTIONS = FORWARDED_OPTIONS | frozenset(
    {"application", "interpret_as", "connect", "cameras"}
)
"""Options with every protocol; all others are those of the protocol's emulated camera."""

FLEET_OPTIONS = frozenset({"scenario", "quirks", "dialect", "transport"})
"""Options of the marker that an emulated fleet gets."""

DEFAULT_CAMERA_COUNT = 2
"""Number of cameras of an emulated fleet if the marker gives none."""

MARKER = (
    "smartcam(application=None, interpret_as=None, connect={}, cameras=2, protocol='bvs', "
    "scenario=None, dialect=..., transport=..., ...): how the fixtures emulated_camera, camera and "
    "emulated_fleet are made. application=ID loads and runs this application; connect={...} are "
    "further options of smartcam.connect(); the rest are options of "
    "smartcam.emulator.EmulatedCamera, or of the protocol's own class. A scenario's file is "
    "looked for beside the test, then below the root."
)

_CLIENT: pytest.StashKey[Camera] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Pytest: the options of the suites that judge cameras and clients."""
    from smartcam.conformance._inside import add_options

    add_options(parser)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Pytest: show the findings about clients; the suite that checks cameras shows its own."""
    from smartcam.conformance._inside import terminal_summary

    terminal_summary(terminalreporter)


def pytest_configure(config: pytest.Config) -> None:
    """Pytest: register the marker."""
    config.addinivalue_line("markers", MARKER)
    pytest.register_assert_rewrite("smartcam.testing._suites.interpreters")


# ---------------------------------------------------------------------- fixtures


@pytest.fixture
def emulated_camera(request: pytest.FixtureRequest) -> Iterator[ThreadedCamera]:
    """An emulated camera over real TCP or UDP, on a free port of this machine.

    It lives in a thread with an event loop of its own, so it serves synchronous and asynchronous
    tests, and programs that a test starts. The marker ``smartcam`` sets its options.
    """
    from smartcam.emulator._inside import emulated_class
    from smartcam.testing import ThreadedCamera

    given = _given_options(request)
    protocol = given.get("protocol", PROTOCOL)
    options = {
        key: value
        for key, value in given.items()
        if key not in MARKER_OPTIONS or key in FORWARDED_OPTIONS
    }
    application = given.get("application")
    if application is not None:
        options = {**emulated_class(protocol).state_options(application, running=True), **options}
    with contextlib.ExitStack() as stack:
        yield _make_or_fail(lambda: stack.enter_context(ThreadedCamera(**options)))


@pytest.fixture
def emulated_fleet(request: pytest.FixtureRequest) -> Iterator[ThreadedFleet]:
    """Emulated cameras by name, like emulated_camera: those of ``scenario``, else ``cameras``."""
    from smartcam.testing import ThreadedFleet

    given = _given_options(request)
    options = {key: value for key, value in given.items() if key in FLEET_OPTIONS}
    scenarios = options.pop("scenario", None)
    if scenarios is None:
        application = given.get("application")
        scenarios = [
            _scenario(given.get("protocol", PROTOCOL), application, number)
            for number in range(1, 1 + given.get("cameras", DEFAULT_CAMERA_COUNT))
        ]
    with contextlib.ExitStack() as stack:
        yield _make_or_fail(lambda: stack.enter_context(ThreadedFleet(scenarios, **options)))


def _scenario(protocol: str, application: int | None, number: int) -> Scenario:
    """Return the scenario of a camera of a fleet, with a running application if it can have one."""
    from smartcam.emulator import Scenario
    from smartcam.emulator._inside import emulated_class

    start_options = emulated_class(protocol).state_options(application, running=True)
    return Scenario(
        name=f"camera{number}",
        protocol=protocol,
        active=application if start_options else None,
        running=bool(start_options) and application is not None,
        seed=number,
    )


@pytest.fixture
def camera(request: pytest.FixtureRequest, emulated_camera: ThreadedCamera) -> Camera:
    """A client of the emulated camera, connected while an asynchronous test runs.

    The client is opened in the test's own task right before the test, and closed right after it.
    So it uses the event loop of the test, whichever plugin made the loop. A fixture that needs the
    client earlier opens it with ``await camera``.
    """
    from smartcam.connecting import connect

    given = _given_options(request)
    client_options = {
        "interpret_as": given.get("interpret_as"),
        "application": given.get("application"),
        **given.get("connect", {}),
    }
    options = {key: value for key, value in client_options.items() if value is not None}
    client = _make_or_fail(lambda: connect(emulated_camera.url, **options))
    request.node.stash[_CLIENT] = client
    return client


def _make_or_fail(make: Callable[[], T]) -> T:
    """Call ``make``; if the marker has a wrong option, fail the test with the error's text."""
    from smartcam.exceptions import SmartCamError

    try:
        return make()
    except (SmartCamError, TypeError, OSError) as exc:
        text = f"the marker smartcam: {exc}"
    pytest.fail(text, pytrace=False)  # after the except block, so that pytest does not show exc


def _given_options(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Return the options of a test's markers; the nearest marker wins."""
    given: dict[str, Any] = {}
    for marker in reversed(list(request.node.iter_markers("smartcam"))):
        if marker.args:
            text = "the marker smartcam takes keyword arguments only, such as application=7"
            pytest.fail(text, pytrace=False)
        given |= marker.kwargs
    known = MARKER_OPTIONS | _camera_options(given)
    unknown = sorted(given.keys() - known)
    if unknown:
        from smartcam._suggestions import did_you_mean

        pytest.fail(
            f"the marker smartcam has no option {unknown[0]!r}; it has {', '.join(sorted(known))}"
            f"{did_you_mean(unknown[0], known)}",
            pytrace=False,
        )
    if isinstance(given.get("scenario"), (str, Path)):
        given["scenario"] = _scenario_path(request, given["scenario"])
    return given


def _camera_options(given: dict[str, Any]) -> frozenset[str]:
    """Return the names of the options that the protocol's emulated camera has."""
    from smartcam.emulator._inside import emulated_class, options_of
    from smartcam.exceptions import SmartCamError

    try:
        kind = emulated_class(given.get("protocol", PROTOCOL))
    except SmartCamError as exc:
        pytest.fail(f"the marker smartcam: {exc}", pytrace=False)
    return options_of(kind) - {"host", "clock"}


def _scenario_path(request: pytest.FixtureRequest, given: str | Path) -> Path:
    """Return a scenario's path: in the test's folder, below the project's root, or as given."""
    folders = (request.path.parent, request.config.rootpath)
    paths = (folder / given for folder in folders)
    return next((path for path in paths if path.exists()), Path(given))


# ---------------------------------------------------------------------- opening the client


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, None]:
    """Pytest: keep the client of the fixture ``camera`` open while the test runs."""
    client = item.stash.get(_CLIENT, None)
    if client is None or not isinstance(item, pytest.Function):
        yield
        return
    test = item.obj
    if not inspect.iscoroutinefunction(test):
        pytest.fail(
            "the fixture camera needs an asynchronous test (async def, run by pytest-asyncio or "
            "anyio); a synchronous one can use emulated_camera.url",
            pytrace=False,
        )
    item.obj = _with_client(test, client)
    yield
    item.obj = test


def _with_client(test: Callable[..., Any], client: Camera) -> Callable[..., Any]:
    """Return the test with the client opened and closed around it, in its own loop and task."""

    @functools.wraps(test)
    async def with_client(*args: Any, **kwargs: Any) -> Any:
        if not _in_asyncio():
            pytest.fail(
                "the fixture camera needs asyncio, and this test runs on another event loop; it "
                "can use emulated_camera.url",
                pytrace=False,
            )
        try:
            if not client.connected:
                await client
            return await test(*args, **kwargs)
        finally:
            await client.close()

    return with_client


def _in_asyncio() -> bool:
    import asyncio  # slow, compared with the rest of this module

    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True
