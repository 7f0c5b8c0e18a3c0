"""Target ``address``: any text as a camera's URL.

Input: the model that is named beside it, then the text.
"""

from __future__ import annotations

from fuzz_input import Choices, text_of

from smartcam.exceptions import ConfigurationError
from smartcam.protocols.base import Protocol
from smartcam.registry import PROTOCOLS
from smartcam.settings import Address, parse_address

__all__ = ["check"]

MODELS = (None, "BVS002C", "bvs002c", "")


def check(data: bytes) -> None:
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
