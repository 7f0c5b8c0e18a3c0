"""The camera of ``docs/adding-a-camera.md``, as a module that can be imported."""

from __future__ import annotations

import re
import sys
import types
from typing import TYPE_CHECKING, Any

from tests import ROOT

if TYPE_CHECKING:
    from smartcam.protocols._framed.machine import Counters, State
    from smartcam.protocols.messages import Message

PAGE = ROOT / "docs" / "adding-a-camera.md"
_TEXT = PAGE.read_text(encoding="utf-8")


def _file(name: str) -> str:
    found = re.search(rf"^```python\n# {name}\n(.*?)^```$", _TEXT, re.DOTALL | re.MULTILINE)
    assert found is not None, name
    return found[1]


MODULE = _file("acme_camera.py")
"""The module in one file."""
TESTS = _file("test_acme.py")
"""Its tests."""

_made = types.ModuleType("acme_page_module")
sys.modules["acme_page_module"] = _made  # where dataclasses look for the names of annotations
exec(compile(MODULE, str(PAGE), "exec", dont_inherit=True), vars(_made))  # noqa: S102

acme: Any = _made
"""The module's names; it has no types."""

if TYPE_CHECKING:

    class AcmeMachine:
        """What the tests use of the machine."""

        state: State
        counters: Counters
        kin: Any
        _asked: Any
        _buffer: bytearray
        _events: list[Any]
        _outbox: list[bytes]

        def __init__(self, *args: Any, **options: Any) -> None: ...
        @property
        def pending(self) -> bytes: ...
        def receive_data(self, data: bytes) -> None: ...
        def receive_eof(self) -> None: ...
        def events(self) -> list[Any]: ...
        def data_to_send(self) -> list[bytes]: ...
        def send(self, message: Message, *, answered: bool | None = None) -> None: ...
        def _read(self, line: str) -> object: ...

else:
    AcmeMachine = acme.AcmeMachine
