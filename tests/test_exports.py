"""The public surface: what each module exports, and what importing costs."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from grids import over

import smartcam

if TYPE_CHECKING:
    import types

PUBLIC = [
    "ApplicationChanged", "Backoff", "CalibrationError", "CameraBusyError", "CameraEvent",
    "CameraFaultError",
    "Capabilities", "CommandRejectedError", "ConfigurationError", "ConnectFailedError",
    "Connected",
    "ConnectionClosedError", "ConnectionLostError", "ConnectionTakenError", "Disconnected",
    "FrameError", "Header", "Histogram", "InputContainerError", "InterpretationError", "Layout",
    "LayoutError", "LinkError", "LocalProtocolError", "Localization", "MessageError",
    "MissingExtraError", "NotRunningError", "Observer", "OvertriggeredError", "PluginError",
    "Pose", "Position", "ProtocolError", "Quaternion", "Reconnected", "RecordingError",
    "RemoteProtocolError",
    "ResponseTimeoutError", "Result", "SmartCamError", "SmartCamera", "Statistics", "Status",
    "StatusChanged", "SubscriberOverflowError", "TriggerError", "TriggerTimeoutError",
    "UnsupportedError", "WrongApplicationError", "__version__", "connect", "emulator",
    "exceptions", "interpreters", "layout", "models", "protocols",
]  # fmt: skip

MODULES = sorted(
    info.name
    for info in pkgutil.walk_packages(smartcam.__path__, "smartcam.", onerror=lambda name: None)
    if not info.name.endswith("__main__")
)

HEAVY = ["asyncio", "construct", "numpy", "pydantic"]


def imported(name: str) -> types.ModuleType | None:
    """Return a module, None where it needs something that is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as exc:
        if exc.name is None or exc.name.startswith("smartcam"):
            raise
        return None


def run(code: str) -> str:
    """Return what ``code`` prints in a fresh interpreter."""
    done = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=True,
        timeout=30,
    )
    return done.stdout.strip()


@over("name", MODULES)
def test_module_exports_resolve_once_each(name: str) -> None:
    module = imported(name)
    exported: list[str] = getattr(module, "__all__", [])
    assert len(set(exported)) == len(exported)
    for one in exported:
        assert hasattr(module, one), one


@over("name", MODULES)
def test_module_with_public_names_has_exports(name: str) -> None:
    module = imported(name)
    own = [
        one
        for one, value in (vars(module) if module else {}).items()
        if not one.startswith("_") and getattr(value, "__module__", None) == name
    ]
    if own and not name.rpartition(".")[2].startswith("_"):
        assert hasattr(module, "__all__"), own


def test_top_level_exports_are_pinned() -> None:
    assert smartcam.__all__ == sorted(PUBLIC)


@over("name", PUBLIC)
def test_top_level_name_is_the_one_of_its_home(name: str) -> None:
    value = getattr(smartcam, name)
    assert getattr(value, "__name__", name).rpartition(".")[2] == name
    assert getattr(smartcam, name) is value


def test_top_level_has_every_public_error() -> None:
    errors = {name for name in smartcam.exceptions.__all__ if name.endswith("Error")}
    assert errors <= set(smartcam.__all__)


def test_dir_lists_what_was_not_used_yet() -> None:
    shown = run("import smartcam; print(set(smartcam.__all__) <= set(dir(smartcam)))")
    assert shown == "True"
    assert "connect" in dir(smartcam)
    assert dir(smartcam) == sorted(dir(smartcam))


@pytest.mark.parametrize("name", ["connnect", "_private", "numpy"])
def test_unknown_attribute_is_an_attribute_error(name: str) -> None:
    with pytest.raises(AttributeError) as caught:
        getattr(smartcam, name)
    assert str(caught.value) == f"module 'smartcam' has no attribute {name!r}"


def test_star_import_gives_the_public_names() -> None:
    shown = run("from smartcam import *; print(Status.BUSY.name, connect.__name__)")
    assert shown == "BUSY connect"


def newly_imported(code: str, watched: list[str]) -> list[str]:
    """Return which of ``watched`` a fresh interpreter imports for ``code``."""
    shown = run(
        f"import sys; before = set(sys.modules); {code}; "
        f"print(*sorted(set({watched}) & (set(sys.modules) - before)))"
    )
    return shown.split()


def test_import_is_light() -> None:
    code = "import smartcam; smartcam.__version__; dir(smartcam)"
    assert newly_imported(code, HEAVY) == []


@pytest.mark.parametrize("name", ["SmartCamError", "Status", "protocols"])
def test_first_use_of_a_light_name_stays_light(name: str) -> None:
    assert newly_imported(f"import smartcam; smartcam.{name}", HEAVY) == []


def test_protocol_core_imports_no_loop_socket_or_logging() -> None:
    code = "import smartcam.protocols.bvs, smartcam.protocols.framed.machine"
    watched = ["socket", "selectors", "logging", *HEAVY]
    assert newly_imported(code, watched) == []
    assert newly_imported("import smartcam._client.link", watched) != []
