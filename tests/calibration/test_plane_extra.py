from __future__ import annotations

import subprocess
import sys

import pytest

from smartcam import MissingExtraError
from smartcam.calibration.optional_imports import load


def test_load_without_the_extra_says_which(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    monkeypatch.delitem(sys.modules, "scipy.special", raising=False)
    with pytest.raises(MissingExtraError, match=r"calibration needs scipy: pip install") as caught:
        load("scipy.special")
    assert caught.value.extra == "calibration"


def test_importing_the_room_loads_neither_scipy_nor_opencv() -> None:
    code = "import sys, smartcam.calibration; print(sorted({'scipy', 'cv2'} & {*sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)  # noqa: S603
    assert done.stdout.decode().strip() == "[]"
