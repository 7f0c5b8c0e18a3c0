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

MAX_WRONG_PASSWORDS: Final = 10
"""Number of wrong passwords after which a connection is closed."""

_PARAMETER: Final = re.compile(r'([A-Za-z]{1,32})=(?:"([^"\\]*)"|([^\s",=]+))\s*(?:,\s*|$)')


class Authentication:
    """A server's user and password.

    Args:
        user: name of the user; None: no password is needed.
        password: password of the user.
        allows_basic: whether Basic is accepted, for clients without Digest.

    Raises:
        ConfigurationError: user or password is missing, or has characters that cannot be sent.
    """

    def __init__(
        self, user: str | None, password: str | None, *, allows_basic: bool = False
    ) -> None:
        if (user is None) != (password is None):
            raise ConfigurationError("RTSP: expected user and password, got one of them")
        if user is not None and (not user or not password or re.search(r'[:"\\]|[^ -~]', user)):
            raise ConfigurationError(
                'RTSP: expected a user of ASCII characters without : " and \\, and a password'
            )
        self.is_required: bool = user is not None
        self.allows_basic = allows_basic
        self._user, self._secret = (user or "").encode(), (password or "").encode()
        self._hashed_secret = _md5(self._user, REALM.encode(), self._secret)

    def accepts(self, request: RtspRequest, nonce: str) -> bool:
        """Return True if a request proves the user's password for the connection's nonce."""
        scheme, _, header = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "digest":
            return self._accepts_digest(request, nonce, header)
        return scheme.lower() == "basic" and self.allows_basic and self._accepts_basic(header)

    def _accepts_digest(self, request: RtspRequest, nonce: str, header: str) -> bool:
        parameters = _digest_parameters(header)
        expected = {"username": self._user.decode(), "realm": REALM, "nonce": nonce}
        matches = [_is_equal(parameters.get(name, ""), value) for name, value in expected.items()]
        if parameters.get("algorithm", "MD5").upper() != "MD5" or "qop" in parameters:
            return False
        uri = parameters.get("uri", "")
        # a prefix is enough: live555 names the stream also in requests for its track
        if not f"{request.url}/".startswith(f"{uri.rstrip('/')}/"):
            return False
        hash_of_request = _md5(request.method.encode(), uri.encode())
        response = _md5(self._hashed_secret.encode(), nonce.encode(), hash_of_request.encode())
        return _is_equal(parameters.get("response", "").lower(), response) and all(matches)

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
        return challenges + basic if self.allows_basic else challenges


class PasswordCheck:
    """The password check of one connection, with a nonce and a limited number of tries."""

    def __init__(self, authentication: Authentication) -> None:
        self._authentication = authentication
        self._nonce = secrets.token_hex(16)
        self._wrong_passwords = 0

    def check(self, request: RtspRequest) -> None:
        """Check a request's authorization.

        Raises:
            RtspError: authorization is missing or wrong; after too many tries the error is fatal.
        """
        if not self._authentication.is_required or self._authentication.accepts(
            request, self._nonce
        ):
            return
        has_authorization = "authorization" in request.headers
        self._wrong_passwords += has_authorization
        text = "wrong user or password" if has_authorization else "a password is required"
        raise RtspError(
            401,
            text,
            self._authentication.challenge(self._nonce),
            fatal=self._wrong_passwords >= MAX_WRONG_PASSWORDS,
        )


def _digest_parameters(header: str) -> dict[str, str]:
    """Return the parameters of a Digest header; empty if the header is malformed."""
    parameters: dict[str, str] = {}
    offset = 0
    header = header.strip()
    while offset < len(header):
        match = _PARAMETER.match(header, offset)
        if match is None or match[1].lower() in parameters:
            return {}
        parameters[match[1].lower()] = match[2] if match[2] is not None else match[3]
        offset = match.end()
    return parameters


def _is_equal(given: str, expected: str) -> bool:
    return hmac.compare_digest(given.encode(), expected.encode())


def _md5(*parts: bytes) -> str:
    return hashlib.md5(b":".join(parts), usedforsecurity=False).hexdigest()
