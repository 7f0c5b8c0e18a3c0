"""Packages that the extra brings, and those of them that are refused."""

from __future__ import annotations

import importlib
import subprocess
import sys

import cv2
import pytest

from smartcam._extras import from_part, load
from smartcam.exceptions import MissingExtraError


@pytest.fixture(autouse=True)
def nothing_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smartcam._extras._LOADED", {})


def test_load_returns_the_module() -> None:
    assert load("cv2") is cv2


def test_load_of_opencv_5_0_0_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "__version__", "5.0.0.93")
    with pytest.raises(MissingExtraError, match=r"OpenCV other than 5\.0\.0\.93, which lacks hand"):
        load("cv2")


@pytest.mark.parametrize("version", ["4.10.0", "4.14.0", "5.0.1", "5.1.0"])
def test_load_of_other_opencv_is_not(monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    monkeypatch.setattr(cv2, "__version__", version)
    assert load("cv2") is cv2


def test_load_of_what_is_not_installed_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(
        MissingExtraError, match=r'needs OpenCV: pip install "smartcam\[calibration\]"'
    ):
        load("cv2")


# ---------------------------------------------------------------------- without the extra


def test_load_without_the_extra_says_which(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    monkeypatch.delitem(sys.modules, "scipy.special", raising=False)
    with pytest.raises(MissingExtraError, match=r"calibration needs SciPy: pip install") as caught:
        load("scipy.special")
    assert caught.value.extra == "calibration"


def test_importing_the_room_loads_neither_scipy_nor_opencv() -> None:
    code = "import sys, smartcam.calibration; print(sorted({'scipy', 'cv2'} & {*sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)  # noqa: S603
    assert done.stdout.decode().strip() == "[]"


# ---------------------------------------------------------------------- without a distribution


def test_import_from_a_part_that_is_missing_says_which_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "smartcam.fleet", None)
    said = r'a camera of a fleet needs smartcam.fleet: pip install "smartcam\[fleet\]"'
    with (
        pytest.raises(MissingExtraError, match=said) as caught,
        from_part("fleet", "a camera of a fleet needs"),
    ):
        importlib.import_module("smartcam.fleet")
    assert caught.value.extra == "fleet"


def test_import_from_a_part_leaves_other_errors_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numpy.nothing", None)
    with pytest.raises(ModuleNotFoundError, match="numpy"), from_part("fleet", "this needs"):
        importlib.import_module("numpy.nothing")
