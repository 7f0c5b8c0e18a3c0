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

_PART: Final = re.compile(r'\s*([A-Za-z0-9_-]{1,32})\s*=\s*(?:"((?:[^"\\]|\\.)*)"|([^\s",]*))\s*,?')


class Challenge(NamedTuple):
    """A server's challenge for a password.

    Attributes:
        scheme: name in lower case.
        parts: parameters by names in lower case.
    """

    scheme: str
    parts: dict[str, str]

    @property
    def algorithm(self) -> str:
        """Name of Digest's hash function, without ``-sess``."""
        return self.parts.get("algorithm", "MD5").upper().removesuffix("-SESS")

    @property
    def rank(self) -> int:
        """Preference of the challenge; 0: not supported."""
        if self.scheme == "basic":
            return 1
        qop = re.split(r"[\s,]+", self.parts.get("qop", "auth").lower())
        known = self.scheme == "digest" and "nonce" in self.parts and "auth" in qop
        return 2 + list(_HASHES).index(self.algorithm) if known and self.algorithm in _HASHES else 0


def challenge_of(headers: Sequence[str]) -> Challenge | None:
    """Return the preferred supported challenge of an answer; None: there is none."""
    read = [_read(header) for header in headers[:MAX_CHALLENGES]]
    best = max(read, key=lambda challenge: challenge.rank, default=None)
    return best if best is not None and best.rank else None


def _read(header: str) -> Challenge:
    scheme, _, given = header.strip().partition(" ")
    parts: dict[str, str] = {}
    place = 0
    while (match := _PART.match(given, place)) is not None:
        value = match[3] if match[2] is None else re.sub(r"\\(.)", r"\1", match[2])
        parts.setdefault(match[1].lower(), value)
        place = match.end()
    return Challenge(scheme.lower(), parts)


class Credentials:
    """A user with a password, and the server's last challenge.

    Args:
        user: name of the user; "": no user.
        password: password of the user.
    """

    def __init__(self, user: str, password: str) -> None:
        self._user, self._password = user, password
        self._challenge: Challenge | None = None
        self._count = 0  # number of requests with the challenge's nonce

    @property
    def known(self) -> bool:
        """True if there is a user."""
        return bool(self._user)

    def challenged(self, headers: Sequence[str]) -> bool:
        """Store a refusal's challenge; return whether another request may succeed."""
        challenge = challenge_of(headers)
        if not self.known or challenge is None:
            return False
        before, self._challenge = self._challenge, challenge
        self._count = 0
        stale = challenge.parts.get("stale", "").lower() == "true"
        return before is None or stale or challenge.parts != before.parts

    def header(self, method: str, uri: str) -> str:
        """Return the value of ``Authorization``; "" without a challenge."""
        challenge = self._challenge
        if challenge is None:
            return ""
        if challenge.scheme == "basic":
            both = f"{self._user}:{self._password}".encode()
            return f"Basic {base64.b64encode(both).decode()}"
        self._count += 1
        return self._digest(challenge, method, uri)

    def _digest(self, challenge: Challenge, method: str, uri: str) -> str:
        given, hashed = challenge.parts, _hash(challenge.algorithm)
        realm, nonce = given.get("realm", ""), given["nonce"]
        secret = hashed(f"{self._user}:{realm}:{self._password}")
        count, client_nonce = f"{self._count:08x}", secrets.token_hex(8)
        session = given.get("algorithm", "").upper().endswith("-SESS")
        if session:
            secret = hashed(f"{secret}:{nonce}:{client_nonce}")
        hash_of_request, quality = hashed(f"{method}:{uri}"), "qop" in given
        middle = f"{nonce}:{count}:{client_nonce}:auth" if quality else nonce
        parts = {"username": self._user, "realm": realm, "nonce": nonce, "uri": uri}
        parts["response"] = hashed(f"{secret}:{middle}:{hash_of_request}")
        shown = [f"{name}={_quoted(value)}" for name, value in parts.items()]
        if "algorithm" in given:
            shown.append(f"algorithm={given['algorithm']}")
        if "opaque" in given:
            shown.append(f"opaque={_quoted(given['opaque'])}")
        if quality or session:
            shown.append(f'cnonce="{client_nonce}"')
        if quality:
            shown += ("qop=auth", f"nc={count}")
        return f"Digest {', '.join(shown)}"


def _hash(algorithm: str) -> Callable[[str], str]:
    def hashed(text: str) -> str:
        return _HASHES[algorithm](text.encode(), usedforsecurity=False).hexdigest()

    return hashed


def _quoted(text: str) -> str:
    escaped = re.sub(r'(["\\])', r"\\\1", text)
    return f'"{escaped}"'
