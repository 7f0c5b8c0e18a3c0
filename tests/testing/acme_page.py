"""The camera of ``docs/adding-a-camera.md``, as a module that can be imported."""

from __future__ import annotations

import re
import sys
import types
from typing import Any

import pytest

from smartcam.registry import PROTOCOLS
from tests import ROOT

PAGE = ROOT / "docs" / "adding-a-camera.md"
_TEXT = PAGE.read_text(encoding="utf-8")


def _file(name: str) -> str:
    found = re.search(rf"^```python\n# {name}\n(.*?)^```$", _TEXT, re.DOTALL | re.MULTILINE)
    assert found is not None, name
    return found[1]


MODULE = _file("acme_camera.py")
"""The module in one file."""
TESTS = (ROOT / "examples/smartcam-acme/tests/test_acme.py").read_text(encoding="utf-8")
"""Its tests, of which the page shows a part."""

_made = types.ModuleType("acme_camera")
exec(compile(MODULE, str(PAGE), "exec", dont_inherit=True), vars(_made))  # noqa: S102

acme: Any = _made
"""The module's names; it has no types."""


@pytest.fixture(autouse=True)
def acme_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register its protocol while a test runs, and its module for Protocol.emulator."""
    monkeypatch.setitem(sys.modules, "acme_camera", _made)
    monkeypatch.setitem(PROTOCOLS._registered, "acme", acme.ACME)
    monkeypatch.setitem(PROTOCOLS._loaded, "acme", acme.ACME)
