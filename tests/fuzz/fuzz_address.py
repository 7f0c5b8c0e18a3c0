"""Target ``address``: any text as a camera's URL.

Input: the model that is named beside it, then the text.
"""

from __future__ import annotations

from fuzz_input import Choices, text_of

from smartcam.exceptions import ConfigurationError
from smartcam.protocols.bvs import BVS
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
    assert address.protocol == BVS.name
    assert address.scheme in BVS.schemes
    assert address.host
    assert 1 <= address.port <= 65535
    assert address.dialect is None or address.dialect in BVS.dialects
    again = printed(address.url)
    assert again == address, f"prints as {address.url!r}, which is {again}"


def printed(url: str) -> Address | str:
    """Return the address that a URL means, or why it means none."""
    try:
        return parse_address(url)
    except ConfigurationError as error:
        return str(error)
