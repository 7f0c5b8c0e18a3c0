"""Fixtures that several modules of the client's tests share."""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, cast

import pytest

import smartcam
from tests import loops
from tests.client.kinds import AT_THE_WIRE, IN_TIME_OF_THEIR_OWN, MODULES, OVER_TCP_ON_A_BUS
from tests.fleet.kinds import connect

LOOPS: Mapping[str, Callable[[], asyncio.AbstractEventLoop]] = {
    "wire": functools.partial(loops.timed),
    "in_process": functools.partial(loops.timed),
    "zenoh": functools.partial(loops.real),  # its threads want real time
}
"""Kinds of cameras, and the event loops that they are tried on."""

IN_REAL_TIME = loops.LOOP == "uvloop"
"""True to run all tests in real time: only those that do so over Zenoh, too, at the wire."""

_LEFT_OUT = {
    "wire": frozenset[str](),
    "in_process": frozenset(name for names in AT_THE_WIRE.values() for name in names),
}
_LEFT_OUT["zenoh"] = _LEFT_OUT["in_process"] | IN_TIME_OF_THEIR_OWN


def pytest_asyncio_loop_factories(
    item: pytest.Item,
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]] | None:
    """Have a test of the behaviour of cameras run with every kind of them."""
    if item.get_closest_marker("real_time"):
        return None
    module = item.parent.name if item.parent is not None else ""
    return LOOPS if module.removesuffix(".py").rpartition("/")[2] in MODULES else None


def _kind(item: pytest.Item) -> str | None:
    """Return the kind of camera that a test is run with; None where there are no kinds."""
    parameters = getattr(getattr(item, "callspec", None), "params", {})
    loop = parameters.get("_asyncio_loop_factory")
    return next((kind for kind, one in LOOPS.items() if one is loop), None)


def _counts_steps(item: pytest.Item) -> bool:
    """Return True if a test counts steps of the loop, or needs something in a few milliseconds."""
    return _says_so(cast("pytest.Function", item).function)


@functools.cache
def _says_so(test: Callable[..., object]) -> bool:
    """Return True if the text of a test says that it counts steps."""
    source = inspect.getsource(test)
    return any(word in source for word in ("steps(", "sleep(0)", "SHORT", "timeout=0"))


def _needs_its_own_time(item: pytest.Item) -> bool:
    """Return True if a test cannot run in real time, or would take long."""
    name = item.name.partition("[")[0]
    return name in _LEFT_OUT["zenoh"] or _counts_steps(item)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what does not hold for a kind; those over Zenoh are long, and sweeps on a bus."""
    kept: list[pytest.Item] = []
    left_out: list[pytest.Item] = []
    for item in items:
        kind = _kind(item)
        if IN_REAL_TIME and (kind != "wire" or _needs_its_own_time(item)):
            left_out.append(item)
            continue
        if kind is not None:
            name, _, parameters = item.name.partition("[")
            others = "-".join(one for one in parameters.rstrip("]").split("-") if one != kind)
            if (
                _LEFT_OUT[kind] & {name, f"{name}[{others}]"}
                or (kind == "zenoh" and _counts_steps(item))
                or (kind != "wire" and name in OVER_TCP_ON_A_BUS and others.endswith("udp"))
            ):
                left_out.append(item)
                continue
            if kind == "zenoh" or (kind == "in_process" and name in IN_TIME_OF_THEIR_OWN):
                item.add_marker(pytest.mark.long)
        kept.append(item)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = kept


@pytest.fixture(autouse=True)
def _kind_of_camera(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have ``smartcam.connect`` give cameras of the kind."""
    kind = _kind(request.node)
    if kind not in {None, "wire"}:
        monkeypatch.setitem(vars(smartcam), "connect", functools.partial(connect, kind))


@pytest.fixture(params=["tcp", "udp"])
def transport(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture
def never_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """However soon a session is lost again, nobody has taken the camera."""
    monkeypatch.setattr("smartcam._client.supervisor.TAKEN_WITHIN", float("-inf"))
