"""Read and set parameters of an RTSP camera as features (RFC 2326, sections 10.8 and 10.9).

The protocol reads and sets a parameter by its name, as text. There are no lists, kinds, ranges,
units or commands; many cameras have no parameters.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NoReturn

from smartcam.exceptions import FrameFeatureError, UnsupportedError
from smartcam.frames._features import DeviceFeatures, Feature, FeatureValue, as_text

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.frames._streaming.rtsp_client.answers import ServerAnswer

GET_METHOD: Final = "GET_PARAMETER"
SET_METHOD: Final = "SET_PARAMETER"

NOT_UNDERSTOOD: Final = 451
READ_ONLY: Final = 458
INVALID_VALUE: Final = 457

UNSUPPORTED_METHOD: Final = (405, 501, 551)
"""Status codes of a camera that does not support parameters."""

MAX_SHOWN_CHARACTERS: Final = 80
"""Largest number of characters of a name, value or answer in an error's text."""


class RtspParameters(DeviceFeatures):
    """The parameters of a camera, by their names in its maker's documents.

    A name is sent unchanged: without a list of names, other spellings cannot be recognized.

    Args:
        name: name of the source, for errors.
        ask: function that sends a method with a body, and returns the answer.
    """

    def __init__(self, name: str, ask: Callable[[str, bytes], Awaitable[ServerAnswer]]) -> None:
        self._name, self._ask = name, ask

    async def names(self) -> list[str]:
        """Raise: RTSP has no list of parameters."""
        self._raise_unsupported(
            "list its parameters: read one by its name in the maker's documents"
        )

    async def describe(self, name: str) -> Feature:
        """Return a parameter with its value as text, without a range."""
        return Feature(name, "string", "rw", value=await self.get(name))

    async def get(self, name: str) -> FeatureValue:
        """Return the value of a parameter, as text."""
        answer = await self._request(GET_METHOD, name, f"{name}\r\n")
        body = answer.body.decode(errors="replace")
        for line in body.splitlines():
            key, colon, value = line.partition(":")
            if colon and key.strip().lower() == name.lower():
                return value.strip()
        actual = (
            f"got {body[:MAX_SHOWN_CHARACTERS]!r}"
            if body.strip()
            else ("got none: the camera uses the request only to keep the session alive")
        )
        raise self._feature_error(name, f"expected its value from {GET_METHOD}, {actual}")

    async def set(self, name: str, value: FeatureValue) -> FeatureValue:
        """Set a parameter; return the camera's new value, or the given value if it reports none.

        The value must be one line.
        """
        text = as_text(value)
        if re.search(r"[\r\n\0]", text):
            shown = repr(text[:MAX_SHOWN_CHARACTERS])
            raise self._feature_error(name, f"expected a value of one line, got {shown}")
        await self._request(SET_METHOD, name, f"{name}: {text}\r\n")
        try:
            return await self.get(name)
        except (FrameFeatureError, UnsupportedError):  # the parameter can be set, but not read
            return value

    async def execute(self, name: str) -> None:
        """Raise: RTSP has no commands."""
        self._raise_unsupported(f"execute a command such as {name[:MAX_SHOWN_CHARACTERS]}")

    async def _request(self, method: str, name: str, body: str) -> ServerAnswer:
        if not re.fullmatch(r"[!-9;-~]+", name):
            text = "expected a name of printable ASCII without blanks and colons"
            raise self._feature_error(name, text)
        answer = await self._ask(method, body.encode())
        if answer.status == 200:
            return answer
        status = f"{method}: {answer.status} {answer.reason}".rstrip()
        if answer.status in UNSUPPORTED_METHOD:
            raise UnsupportedError(f"{self._name}: it has no such request: {status}")
        reason = {
            NOT_UNDERSTOOD: "there is no such parameter",
            READ_ONLY: "it can only be read",
            INVALID_VALUE: "the camera does not accept the value",
        }.get(answer.status, "it refuses that")
        raise self._feature_error(name, f"{reason}: {status}")

    def _raise_unsupported(self, action: str) -> NoReturn:
        raise UnsupportedError(f"{self._name}: a camera of RTSP cannot {action}")

    def _feature_error(self, name: str, text: str) -> FrameFeatureError:
        shown = name[:MAX_SHOWN_CHARACTERS]
        return FrameFeatureError(f"{self._name}: parameter {shown!r}: {text}", source=self._name)
