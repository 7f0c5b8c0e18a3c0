"""Target ``spec``: any text as ``interpret_as``, on the command line or in a program.

Input: the text.
"""

from __future__ import annotations

from fuzz_input import text_of

from smartcam.exceptions import ConfigurationError, LayoutError
from smartcam.interpreters import Interpreter, resolve

__all__ = ["check"]


def check(data: bytes) -> None:
    """Resolve a specification: an interpreter, or an error that says what is wrong."""
    text = text_of(data)
    try:
        interpreter = resolve(text)
    except LayoutError as error:
        assert error.text == text
        assert 0 <= error.position <= len(text)
        return
    except ConfigurationError as error:
        assert str(error)
        return
    assert isinstance(interpreter, Interpreter)
    layout = interpreter.layout
    if layout is not None and layout.text != interpreter.default_layout:
        name = type(interpreter).__name__.lower()
        again = resolve(f"{name}: {layout.text}")
        assert type(again) is type(interpreter)
        assert again.layout == layout
    lenient = resolve(text, lenient=True)
    assert type(lenient) is type(interpreter)
    assert lenient.layout is None or lenient.layout.lenient
