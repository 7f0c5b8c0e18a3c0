"""Parse URLs of frame sources."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, unquote, urlsplit

from smartcam._arguments import check_text, fspath_of
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True, slots=True)
class FrameAddress:
    """The parts of the URL of a frame source.

    Attributes:
        url: original URL.
        scheme: part of the URL before ``://``, in lower case; ``file`` for a bare path.
        host: name or address; "" if the URL has none.
        port: port; None: the default of the scheme.
        path: part after the host, with its first slash; a bare path as a whole.
        query: part after ``?``.
        user: name of the user before the host, or "".
        password: password of the user, or ""; no text shows the password.
        fragment: part after ``#``: smartcam's parameters if the query belongs to the server.
    """

    url: str
    scheme: str
    host: str
    port: int | None
    path: str
    query: str
    user: str
    password: str
    fragment: str = ""

    @classmethod
    def parse(cls, url: str) -> FrameAddress:
        """Read a URL, or the path of a file.

        Raises:
            ConfigurationError: the text is not valid.
        """
        given = check_text(fspath_of(url), "frame source").strip()
        if not given:
            raise ConfigurationError("frame source: expected a URL or a path, got ''")
        if "://" not in given:
            return cls(given, "file", "", None, str(Path(given)), "", "", "")
        try:
            parts = urlsplit(given)
            port = parts.port
        except ValueError as exc:
            raise ConfigurationError(f"frame source {_masked(given)!r}: {exc}") from exc
        return cls(
            given,
            parts.scheme,
            parts.hostname or "",
            port,
            unquote(parts.path),
            parts.query,
            unquote(parts.username or ""),
            unquote(parts.password or ""),
            parts.fragment,
        )

    @property
    def shown(self) -> str:
        """The URL without a password."""
        return _masked(self.url)

    def __repr__(self) -> str:
        """Return the URL without the password."""
        return f"FrameAddress({self.shown!r})"

    def parameters(self, known: Sequence[str], part: str | None = None) -> dict[str, str]:
        """Return the parameters in the query, or in another part of the URL.

        Raises:
            ConfigurationError: a parameter is unknown, or given twice.
        """
        parameters: dict[str, str] = {}
        for name, value in parse_qsl(self.query if part is None else part, keep_blank_values=True):
            if name not in known:
                raise ConfigurationError(
                    f"frame source {self.shown!r}: unknown parameter {name!r}; known are "
                    f"{', '.join(known)}{did_you_mean(name, known)}"
                )
            if name in parameters:
                raise ConfigurationError(
                    f"frame source {self.shown!r}: parameter {name!r} is given twice"
                )
            parameters[name] = value
        return parameters

    def size(self, text: str) -> tuple[int, int]:
        """Parse ``WIDTHxHEIGHT``.

        Raises:
            ConfigurationError: the text has another form.
        """
        match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
        if match is None:
            raise self.wrong("size", "WIDTHxHEIGHT, such as 640x480", text)
        return int(match[1]), int(match[2])

    def number(self, name: str, text: str, minimum: float, maximum: float) -> float:
        """Return a parameter's number.

        Raises:
            ConfigurationError: the value is not valid, or not from ``minimum`` to ``maximum``.
        """
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not minimum <= value <= maximum:
            raise self.wrong(name, f"a number from {minimum:g} to {maximum:g}", text)
        return value

    def wrong(self, name: str, expected: str, actual: str) -> ConfigurationError:
        """Return the error for a wrong parameter."""
        return ConfigurationError(
            f"frame source {self.shown!r}: {name}: expected {expected}, got {actual!r}"
        )


def _masked(url: str) -> str:
    url = re.sub(r"(//[^/?#@:]*):[^/?#@]*@", r"\1:***@", url)
    return re.sub(r"(?i)([?&#][^=&#]*(?:pass|pwd|token|secret|key)[^=&#]*=)[^&#]*", r"\1***", url)
