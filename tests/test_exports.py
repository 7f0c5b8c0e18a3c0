"""The public surface: what each module exports, what importing costs; no circle of imports."""

from __future__ import annotations

import ast
import graphlib
import importlib
import pkgutil
import re
import subprocess
import sys
import types

import pytest

import smartcam
from tests import ROOT
from tests.imports import imports, is_door, package, statements
from tests.strategies import over

PUBLIC = [
    "ApplicationChanged", "Backoff", "CalibrationError", "Camera", "CameraBusyError", "CameraEvent",
    "CameraFaultError",
    "Capabilities", "CommandRejectedError", "ConfigurationError", "ConnectFailedError",
    "Connected",
    "ConnectionClosedError", "ConnectionLostError", "ConnectionTakenError", "Disconnected",
    "EntryRefusedError", "FrameError", "FrameFeatureError", "FrameFormatError", "FrameLostError",
    "FrameSourceError", "FrameTimeoutError",
    "Header", "InputContainerError", "InspectionError", "InterpretationError",
    "Layout",
    "LayoutError", "LinkError", "LocalProtocolError", "Localization", "MessageError",
    "MissingExtraError", "NotAllowedError", "NotRunningError", "NoticeReceived", "Observer",
    "OutletError",
    "OvertriggeredError",
    "PluginError",
    "Pose", "Position", "ProtocolError", "Quaternion", "Reconnected", "RecordingError",
    "RemoteProtocolError", "ReservationLostError",
    "ResponseTimeoutError", "Result", "RosError", "RosMessageError", "ServiceCallError",
    "ServiceTimeoutError", "SmartCamError", "SmartCamera", "Statistics", "Status",
    "StatusChanged", "SubscriberOverflowError", "TriggerError", "TriggerTimeoutError",
    "UnsupportedError", "WrongApplicationError", "__version__", "connect", "emulator",
    "exceptions", "find", "frames", "interpreters", "layout", "models", "protocols",
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
        timeout=120,
    )
    return done.stdout.strip()


PUBLIC_MODULES = [name for name in MODULES if "._" not in name and ".test_" not in name]


@over("name", PUBLIC_MODULES)
def test_public_module_says_what_is_public(name: str) -> None:
    module = imported(name)
    exported: list[str] = getattr(module, "__all__", [])
    assert len(set(exported)) == len(exported)
    for one in exported:
        assert hasattr(module, one), one
    if name not in DOORLESS:
        assert exported or module is None


@over("name", [name for name in MODULES if "._" in name])
def test_private_module_lists_nothing_but_what_other_rooms_use(name: str) -> None:
    assert hasattr(imported(name), "__all__") is name.endswith("._inside")


DOORLESS = {"smartcam.conformance"}
"""Hold rooms, and nothing to import."""


def test_reference_has_each_public_name_and_nothing_else() -> None:
    page = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^\.\. automodule:: (\S+)$", page, re.MULTILINE))
    assert shown == set(PUBLIC_MODULES) - DOORLESS - {"smartcam.pytest_plugin"}
    assert "._" not in page
    named: dict[int, set[str]] = {}
    for name in ["smartcam", *shown]:
        module = imported(name)
        for one in getattr(module, "__all__", []):
            value = getattr(module, one)
            if not isinstance(value, types.ModuleType):
                named.setdefault(id(value), set()).add(one)
    assert len(named) == PUBLIC_NAMES
    assert len(smartcam.__all__) <= MAX_AT_THE_TOP


PUBLIC_NAMES = 433
"""Number of all public names, a name that stands in two places counted once. It only falls: lower
it with each name that goes. ``docs/decisions/0039-public-names.md`` says what is public."""

MAX_AT_THE_TOP = 75


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
    code = "import smartcam.protocols._bvs, smartcam.protocols._framed.machine"
    watched = ["socket", "selectors", "logging", *HEAVY]
    assert newly_imported(code, watched) == []
    assert newly_imported("import smartcam._client.link", watched) != []


# ---------------------------------------------------------------------- circles and class names


def test_imports_have_no_circle_not_even_in_functions() -> None:
    graph = {
        name: {one.home for one in imports(name, tree) if one.runs} - {name}
        for name, tree in package().items()
        if not is_door(name)  # which imports what stands behind it when that is used
    }
    assert sum(map(len, graph.values())) > len(graph)
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names it


def test_class_name_means_one_thing() -> None:
    """But for words that two fields have: a frame, a doctor's and a tool's finding, and others."""
    found: dict[str, list[str]] = {}
    for module, tree in package().items():
        for node in statements(tree):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name.lstrip("_"), []).append(module)
    twice = {name: modules for name, modules in found.items() if len(modules) > 1}
    inspection = "smartcam.inspection._finding"
    assert twice == {
        "Finding": ["smartcam.doctor._findings", inspection],
        "Frame": ["smartcam.frames._frame", "smartcam.protocols._machine"],
        "Inspection": ["smartcam.emulator._bvs.device", inspection],
        "Picture": ["smartcam.inspection._picture", "smartcam.web._live_view"],
        "Program": ["smartcam.fleet._program.program", "smartcam.inspection._program"],
    }
