"""Authenticate viewers: Digest and Basic (RFC 2617)."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import re
import secrets
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import ConfigurationError
from smartcam.frames._streaming.rtsp.messages import RtspError

if TYPE_CHECKING:
    from smartcam.frames._streaming.rtsp.messages import RtspRequest


REALM: Final = "smartcam"

MAX_WRONG_ANSWERS: Final = 10
"""Largest number of wrong passwords of a connection."""

_PART: Final = re.compile(r'([A-Za-z]{1,32})=(?:"([^"\\]*)"|([^\s",=]+))\s*(?:,\s*|$)')


class Authentication:
    """A server's user and password.

    Args:
        user: name of the user; None: no password is needed.
        password: password of the user.
        basic: whether to accept Basic, for clients without Digest.

    Raises:
        ConfigurationError: user or password is missing, or has characters that cannot be sent.
    """

    def __init__(self, user: str | None, password: str | None, *, basic: bool = False) -> None:
        if (user is None) != (password is None):
            raise ConfigurationError("RTSP: expected user and password, got one of them")
        if user is not None and (not user or not password or re.search(r'[:"\\]|[^ -~]', user)):
            raise ConfigurationError(
                'RTSP: expected a user of ASCII characters without : " and \\, and a password'
            )
        self.wanted: bool = user is not None
        self.basic = basic
        self._user, self._secret = (user or "").encode(), (password or "").encode()
        self._hashed = _md5(self._user, REALM.encode(), self._secret)

    def accepts(self, request: RtspRequest, nonce: str) -> bool:
        """Return True if a request proves the user's password for the connection's nonce."""
        scheme, _, header = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "digest":
            return self._accepts_digest(request, nonce, header)
        return scheme.lower() == "basic" and self.basic and self._accepts_basic(header)

    def _accepts_digest(self, request: RtspRequest, nonce: str, header: str) -> bool:
        parts = _parts(header)
        expected = {"username": self._user.decode(), "realm": REALM, "nonce": nonce}
        same = [_same(parts.get(name, ""), value) for name, value in expected.items()]
        if parts.get("algorithm", "MD5").upper() != "MD5" or "qop" in parts:
            return False
        uri = parts.get("uri", "")
        if not f"{request.url}/".startswith(f"{uri.rstrip('/')}/"):
            return False  # live555 names the stream also in requests for its track
        hash_of_request = _md5(request.method.encode(), uri.encode())
        response = _md5(self._hashed.encode(), nonce.encode(), hash_of_request.encode())
        return _same(parts.get("response", "").lower(), response) and all(same)

    def _accepts_basic(self, header: str) -> bool:
        try:
            given = base64.b64decode(header.strip().encode("latin-1"), validate=True)
        except binascii.Error:
            return False
        return hmac.compare_digest(given, self._user + b":" + self._secret)

    def challenge(self, nonce: str) -> tuple[tuple[str, str], ...]:
        """Return the headers that request authorization."""
        digest = f'Digest realm="{REALM}", nonce="{nonce}", algorithm="MD5"'
        challenges = (("WWW-Authenticate", digest),)
        basic = (("WWW-Authenticate", f'Basic realm="{REALM}"'),)
        return challenges + basic if self.basic else challenges


class PasswordGate:
    """The password check of one connection, with a nonce and a limited number of tries."""

    def __init__(self, authentication: Authentication) -> None:
        self._authentication = authentication
        self._nonce = secrets.token_hex(16)
        self._wrong = 0

    def check(self, request: RtspRequest) -> None:
        """Check a request's authorization.

        Raises:
            RtspError: authorization is missing or wrong; after too many tries the error is fatal.
        """
        if not self._authentication.wanted or self._authentication.accepts(request, self._nonce):
            return
        given = "authorization" in request.headers
        self._wrong += given
        text = "wrong user or password" if given else "a password is required"
        raise RtspError(
            401,
            text,
            self._authentication.challenge(self._nonce),
            fatal=self._wrong >= MAX_WRONG_ANSWERS,
        )


def _parts(header: str) -> dict[str, str]:
    """Return the parts of a Digest; empty if it is malformed."""
    parts: dict[str, str] = {}
    place = 0
    header = header.strip()
    while place < len(header):
        match = _PART.match(header, place)
        if match is None or match[1].lower() in parts:
            return {}
        parts[match[1].lower()] = match[2] if match[2] is not None else match[3]
        place = match.end()
    return parts


def _same(given: str, expected: str) -> bool:
    return hmac.compare_digest(given.encode(), expected.encode())


def _md5(*parts: bytes) -> str:
    return hashlib.md5(b":".join(parts), usedforsecurity=False).hexdigest()
