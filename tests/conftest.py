"""Profiles of Hypothesis, the event loop of the tests, and the check that none leaves anything."""

from __future__ import annotations

import asyncio
import atexit
import gc
import importlib
import inspect
import os
import re
import shutil
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

from tests import loops

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Generator

settings.register_profile("few", deadline=None, max_examples=3, derandomize=True)
settings.register_profile("quick", deadline=None, max_examples=10, derandomize=True)
settings.register_profile("ci", deadline=None, max_examples=50, derandomize=True)
settings.register_profile("nightly", deadline=None, max_examples=2000, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))

ROOT = Path(__file__).parent.parent

ONLY_LONG = frozenset({"long", "long and not widest", "judged"})
"""Choices of marks by which only ``long`` tests run."""

SOME_LONG = re.compile(
    r"\b(long|sampled|judged|widest|LONG|ONE_LONG|BROWSER_MARKS|needs_tshark)\b|_long\b"
)
"""Pattern of the words of which each module that has ``long`` tests has one; those of the client
get the mark by their connection, too, and need none."""

CLIENT = Path(__file__).parent / "client"

ALL_LONG = re.compile(r"^pytestmark = (\[[^]]*)?pytest\.mark\.long\b(?!\()", re.MULTILINE)
"""Pattern of the line that marks all tests of a module as ``long``."""

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    # Tests run side by side, and their matrices are small: more threads of one test wait for each
    # other, at the full cost of a processor. What a test starts has this, too.
    os.environ.setdefault(threads, "1")

if sys.dont_write_bytecode:
    # Where nothing is to be written beside the sources, workers and the processes that tests start
    # would compile all that they import, each for itself. They share it while the tests run.
    compiled = tempfile.mkdtemp(prefix="smartcam-compiled-")
    atexit.register(shutil.rmtree, compiled, ignore_errors=True)
    sys.dont_write_bytecode, sys.pycache_prefix = False, compiled
    os.environ["PYTHONPYCACHEPREFIX"] = compiled
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_asyncio_loop_factories(
    item: pytest.Item,
) -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Give asynchronous tests a loop on a time of its own, those marked ``real_time`` the usual.

    Those marked ``both_buses`` run on each: with the bus inside the process, and over Zenoh. Those
    marked ``through_rclpy`` do, too: with a node on paper, and with one of rclpy.
    """
    if item.get_closest_marker("both_buses"):
        return {"timed": loops.timed, "real": loops.real}
    if item.get_closest_marker("real_time"):
        return {"real": loops.real}
    marker = item.get_closest_marker("through_rclpy")
    if marker is not None and marker.args != (False,):
        return {"paper": loops.timed, "rclpy": loops.real}
    return {"timed": loops.timed}


def pytest_configure() -> None:
    """In a shell's background Ctrl-C is ignored, and so it would be in all that tests start."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Run two more than there are cores, since many tests wait; a few files or tests run alone."""
    few = len(config.args) <= 3 and all(".py" in one for one in config.args)
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return 0 if few or cores == 1 else cores + 2


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Collect the tests without garbage collections: of what is made here hardly anything goes."""
    gc.disable()
    try:
        _import_from_ones_own_place_on(session)
        return (yield)
    finally:
        gc.enable()


def _import_from_ones_own_place_on(session: pytest.Session) -> None:
    """Have each worker import the tests from another place on: they read what another compiled.

    Side by side from the first to the last, all would rewrite and compile each file at once.
    """
    worker = getattr(session.config, "workerinput", None)
    if worker is None or worker["workercount"] == 1:
        return
    paths = [Path(one.split("::")[0]).absolute() for one in session.config.args]
    found = {file for path in paths for file in _test_files(path)}
    files = sorted(one for one in found if not pytest_ignore_collect(one, session.config))
    number, count = int(worker["workerid"].removeprefix("gw")), worker["workercount"]
    begin = len(files) * number // count
    for file in files[begin:] + files[:begin]:
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        try:
            importlib.import_module(name)
        except (Exception, pytest.skip.Exception):  # noqa: BLE001, S112 - pytest tells of it
            continue


def _test_files(path: Path) -> list[Path]:
    """Return the modules of tests at ``path`` that are imported as a part of this package."""
    if not path.is_relative_to(ROOT / "tests"):
        return []
    return list(path.rglob("test_*.py")) if path.is_dir() else [path] if path.is_file() else []


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Spare a run the modules of which it has no test: all are ``long``, or none is."""
    marks = config.option.markexpr
    if not collection_path.match("test_*.py") or marks not in {"not long", *ONLY_LONG}:
        return None
    text = collection_path.read_text(encoding="utf-8")
    if marks == "not long":
        return ALL_LONG.search(text) is not None or None
    if marks != "judged" and collection_path.is_relative_to(CLIENT):
        return None
    return SOME_LONG.search(text) is None or None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as ``long`` the cases of a ``sampled`` test that the short run leaves out.

    Of each row of ``every`` cases one stays, and in the next row the one before its place: so the
    values of the parameter that changes fastest take turns. Of the others every third one is
    ``judged``, and the rest ``widest``. With ``SMARTCAM_TEST_CASES=first`` one case of each test
    stays. What is marked ``judged`` is ``long``.
    """
    first_alone = os.environ.get("SMARTCAM_TEST_CASES") == "first"
    counts: Counter[tuple[Any, str]] = Counter()
    left_out: Counter[tuple[Any, str]] = Counter()
    long_ones: set[Path] = set()
    for item in items:
        marker = item.get_closest_marker("sampled")
        if item.get_closest_marker("judged"):
            item.add_marker(pytest.mark.long)
        if item.get_closest_marker("long"):
            long_ones.add(item.path)
            continue
        if marker is None and not first_alone:
            continue
        test = (item.parent, getattr(item, "originalname", ""))
        every = sys.maxsize if marker is None or first_alone else marker.kwargs["every"]
        row, place = divmod(counts[test], every)
        if (row + place) % every:
            item.add_marker(pytest.mark.long)
            item.add_marker(pytest.mark.widest if left_out[test] % 3 else pytest.mark.judged)
            left_out[test] += 1
        counts[test] += 1
    for path in long_ones:
        found = SOME_LONG.search(path.read_text(encoding="utf-8"))
        if found is None and not path.is_relative_to(CLIENT):
            raise pytest.UsageError(f"{path} has long tests, but not a word of {SOME_LONG.pattern}")


def pytest_collection_finish() -> None:
    """Spare each garbage collection the tests themselves: what there is now stays to the end."""
    gc.collect()
    gc.freeze()


GRACE_STEPS = 100
"""Loop steps that what was cancelled or aborted gets to end itself."""


def open_resources(loop: asyncio.AbstractEventLoop) -> set[Any]:
    """Return what is open in ``loop``: tasks, transports, servers, and whatever else it watches.

    Transports and sockets are those of a selector loop; another kind of loop shows tasks only.
    """
    found: set[Any] = {task for task in asyncio.all_tasks(loop) if not task.done()}
    found.discard(asyncio.current_task(loop))
    transports = dict(getattr(loop, "_transports", {}))
    found |= {one for one in transports.values() if getattr(one, "_sock", None) is not None}
    selector = getattr(loop, "_selector", None)
    own = getattr(loop, "_ssock", None)
    for key in selector.get_map().values() if selector is not None else ():
        if key.fd not in transports and own is not None and key.fd != own.fileno():
            handle = key.data[0] or key.data[1]
            servers = [one for one in handle._args or () if isinstance(one, asyncio.Server)]
            found.add(servers[0] if servers else f"a watch on file descriptor {key.fd}")
    return found


@pytest.fixture
async def no_leaks() -> AsyncIterator[None]:
    """Fail a test that leaves a task, a transport or a listening socket behind.

    It is asynchronous because a synchronous fixture runs without a loop and sees nothing.
    """
    loop = asyncio.get_running_loop()
    before = open_resources(loop)
    yield
    for _ in range(GRACE_STEPS):
        if not open_resources(loop) - before:
            return
        await asyncio.sleep(0)
    left = open_resources(loop) - before
    for one in left:
        if isinstance(one, asyncio.Task):
            one.cancel()
        elif isinstance(one, asyncio.Transport):
            one.abort()
        elif hasattr(one, "close"):
            one.close()
    await asyncio.sleep(0)
    if left:
        names = "; ".join(sorted(repr(one) for one in left))
        pytest.fail(f"the test left behind: {names}", pytrace=False)


@pytest.fixture(autouse=True)
def _no_leaks_in_async_tests(request: pytest.FixtureRequest) -> None:
    """Give every asynchronous test the check above; synchronous ones get no loop for it."""
    test = getattr(request, "function", None)
    inner = getattr(getattr(test, "hypothesis", None), "inner_test", test)
    if inspect.iscoroutinefunction(inner):
        request.getfixturevalue("no_leaks")
