"""Answer a server's challenge for a password: Basic (RFC 7617) and Digest (RFC 7616)."""

from __future__ import annotations

import base64
import hashlib
import re
import secrets
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


MAX_CHALLENGES: Final = 8
"""Largest number of challenges of one answer that are read."""

_HASHES: Final = {"MD5": hashlib.md5, "SHA-256": hashlib.sha256}
"""Hash functions by their names in challenges; the last one is preferred."""

_PARAMETER: Final = re.compile(
    r'\s*([A-Za-z0-9_-]{1,32})\s*=\s*(?:"((?:[^"\\]|\\.)*)"|([^\s",]*))\s*,?'
)


class Challenge(NamedTuple):
    """A server's challenge for a password.

    Attributes:
        scheme: name in lower case.
        parameters: parameters by names in lower case.
    """

    scheme: str
    parameters: dict[str, str]

    @property
    def algorithm(self) -> str:
        """Name of Digest's hash function, without ``-sess``."""
        return self.parameters.get("algorithm", "MD5").upper().removesuffix("-SESS")

    @property
    def rank(self) -> int:
        """Preference of the challenge; 0: not supported."""
        if self.scheme == "basic":
            return 1
        qop = re.split(r"[\s,]+", self.parameters.get("qop", "auth").lower())
        is_supported = self.scheme == "digest" and "nonce" in self.parameters and "auth" in qop
        return (
            2 + list(_HASHES).index(self.algorithm)
            if is_supported and self.algorithm in _HASHES
            else 0
        )


def challenge_of(headers: Sequence[str]) -> Challenge | None:
    """Return the preferred supported challenge of an answer; None: there is none."""
    challenges = [_parse_challenge(header) for header in headers[:MAX_CHALLENGES]]
    best = max(challenges, key=lambda challenge: challenge.rank, default=None)
    return best if best is not None and best.rank else None


def _parse_challenge(header: str) -> Challenge:
    scheme, _, text = header.strip().partition(" ")
    parameters: dict[str, str] = {}
    offset = 0
    while (match := _PARAMETER.match(text, offset)) is not None:
        value = match[3] if match[2] is None else re.sub(r"\\(.)", r"\1", match[2])
        parameters.setdefault(match[1].lower(), value)
        offset = match.end()
    return Challenge(scheme.lower(), parameters)


class Credentials:
    """A user with a password, and the server's last challenge.

    Args:
        user: name of the user; "": no user.
        password: password of the user.
    """

    def __init__(self, user: str, password: str) -> None:
        self._user, self._password = user, password
        self._challenge: Challenge | None = None
        self._request_count = 0  # number of requests with the challenge's nonce

    @property
    def has_user(self) -> bool:
        """True if there is a user."""
        return bool(self._user)

    def store_challenge(self, headers: Sequence[str]) -> bool:
        """Store the challenge of a refusal; return False if another request would fail, too."""
        challenge = challenge_of(headers)
        if not self.has_user or challenge is None:
            return False
        previous, self._challenge = self._challenge, challenge
        self._request_count = 0
        is_stale = challenge.parameters.get("stale", "").lower() == "true"
        return previous is None or is_stale or challenge.parameters != previous.parameters

    def header(self, method: str, uri: str) -> str:
        """Return the value of ``Authorization``; "" without a challenge."""
        challenge = self._challenge
        if challenge is None:
            return ""
        if challenge.scheme == "basic":
            user_and_password = f"{self._user}:{self._password}".encode()
            return f"Basic {base64.b64encode(user_and_password).decode()}"
        self._request_count += 1
        return self._digest(challenge, method, uri)

    def _digest(self, challenge: Challenge, method: str, uri: str) -> str:
        given, hash_text = challenge.parameters, _hash_function(challenge.algorithm)
        realm, nonce = given.get("realm", ""), given["nonce"]
        secret = hash_text(f"{self._user}:{realm}:{self._password}")
        count, client_nonce = f"{self._request_count:08x}", secrets.token_hex(8)
        is_session = given.get("algorithm", "").upper().endswith("-SESS")
        if is_session:
            secret = hash_text(f"{secret}:{nonce}:{client_nonce}")
        hash_of_request, has_qop = hash_text(f"{method}:{uri}"), "qop" in given
        middle = f"{nonce}:{count}:{client_nonce}:auth" if has_qop else nonce
        parameters = {"username": self._user, "realm": realm, "nonce": nonce, "uri": uri}
        parameters["response"] = hash_text(f"{secret}:{middle}:{hash_of_request}")
        fields = [f"{name}={_quoted(value)}" for name, value in parameters.items()]
        if "algorithm" in given:
            fields.append(f"algorithm={given['algorithm']}")
        if "opaque" in given:
            fields.append(f"opaque={_quoted(given['opaque'])}")
        if has_qop or is_session:
            fields.append(f'cnonce="{client_nonce}"')
        if has_qop:
            fields += ("qop=auth", f"nc={count}")
        return f"Digest {', '.join(fields)}"


def _hash_function(algorithm: str) -> Callable[[str], str]:
    def hash_text(text: str) -> str:
        return _HASHES[algorithm](text.encode(), usedforsecurity=False).hexdigest()

    return hash_text


def _quoted(text: str) -> str:
    escaped = re.sub(r'(["\\])', r"\\\1", text)
    return f'"{escaped}"'
