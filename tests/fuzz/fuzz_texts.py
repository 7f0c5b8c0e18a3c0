"""Targets that read one short text or file: ``address``, ``layout_file`` and ``spec``.

- ``address``: any text as a camera's URL. Input: the model that is named beside it, then the text.
- ``layout_file``: any text as a layout's YAML file. Input: the file.
- ``spec``: any text as ``interpret_as``, on the command line or in a program. Input: the text.
"""

from __future__ import annotations

from smartcam.exceptions import ConfigurationError, LayoutError
from smartcam.interpreters import Interpreter, resolve
from smartcam.layout import Layout
from smartcam.protocols import Protocol
from smartcam.registry import PROTOCOLS
from smartcam.settings import Address, parse_address
from tests.fuzz.fuzz_input import Choices, text_of

MODELS = (None, "BVS002C", "bvs002c", "")


def check_address(data: bytes) -> None:
    """Read an address: it means one camera and prints so, or the error says what is wrong."""
    choices = Choices(data)
    model, text = choices.pick(MODELS), text_of(choices.rest())
    try:
        address = parse_address(text, model=model)
    except ConfigurationError as error:
        assert len(str(error)) < 300 + 12 * len(text)
        return
    protocol = PROTOCOLS.load(address.protocol)
    assert isinstance(protocol, Protocol)
    assert address.scheme in protocol.schemes
    assert address.host
    assert 1 <= address.port <= 65535
    assert address.dialect is None or address.dialect in protocol.dialects
    assert address.dialect is not None or not address.quirks
    assert {name for name, _ in address.parameters} <= {*protocol.parameters}
    again = printed(address.url)
    if isinstance(again, Address):  # a password is never printed
        assert dict(again.parameters).get("password", "") == ""
        again = again._replace(parameters=without_password(again))
    public = address._replace(parameters=without_password(address))
    assert again == public, f"prints as {address.url!r}, which is {again}"


def without_password(address: Address) -> tuple[tuple[str, str], ...]:
    """Return the parameters that a URL shows, by their names; one without a value is none."""
    shown = ((name, value) for name, value in address.parameters if name != "password" and value)
    return tuple(sorted(shown))


def printed(url: str) -> Address | str:
    """Return the address that a URL means, or why it means none."""
    try:
        return parse_address(url)
    except ConfigurationError as error:
        return str(error)


def check_layout_file(data: bytes) -> None:
    """Read a file: a layout that writes itself back, or an error."""
    try:
        layout = Layout.from_yaml(text_of(data))
    except LayoutError as error:
        assert 0 <= error.position <= len(error.text)
        return
    except ConfigurationError as error:
        assert str(error)
        return
    assert Layout.from_yaml(layout.to_yaml()) == layout
    assert Layout.from_dict(layout.to_dict()) == layout
    assert Layout(layout.text, lenient=layout.lenient) == layout


def check_spec(data: bytes) -> None:
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
        name = type(interpreter).__name__.removesuffix("Interpreter").lower()
        again = resolve(f"{name}: {layout.text}")
        assert type(again) is type(interpreter)
        assert again.layout == layout
    lenient = resolve(text, lenient=True)
    assert type(lenient) is type(interpreter)
    assert lenient.layout is None or lenient.layout.lenient
