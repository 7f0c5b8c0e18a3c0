"""Guard a site: check Host, Origin and token, and set the headers of every answer.

A page of another web site runs in the same browser and can send requests to this machine. It must
neither read nor change anything here, whatever name it uses for this machine:

- If no token is required, *Host* must be a name of this machine; if the site listens on loopback
  only, a name of loopback. Other names that resolve to this machine (DNS rebinding) are refused.
- *Origin*, which a browser sends with each change, must be the site itself; *Sec-Fetch-Site* must
  not name another site.
- If a token is required, each call carries the token in ``Authorization``. A browser cannot set
  this header for a WebSocket, so a WebSocket carries the token as a subprotocol.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from smartcam._accepting import is_loopback
from smartcam.exceptions import ConfigurationError
from smartcam.web._errors import RefusedError, short_repr

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from aiohttp import web

MIN_TOKEN_CHARACTERS = 16
"""Least number of characters of a token, which must be hard to guess. New tokens have 32."""

BEARER = "bearer."
"""Prefix of the WebSocket protocol that carries the token."""

HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Server": "smartcam",
}
"""Headers of every answer: load nothing from other sites, allow no framing, store nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Guard:
    """The checks of one site."""

    token: str | None  # token that calls must carry; None: calls need none

    def check(self, request: web.Request, *, is_call: bool) -> None:
        """Refuse a request that does not come from the site's own pages.

        The files of the page need no token, since they hold no secret.

        Raises:
            RefusedError: 403 for a request of another site, 401 for a missing or wrong token.
        """
        if self.token is None:
            check_host(request.host)
        if is_call:
            _check_origin(request)
            self._check_token(_authorization(request))

    def _check_token(self, header: str | None) -> None:
        if self.token is None:
            return
        expected = f"Bearer {self.token}".encode()
        received = (header or "").encode("utf-8", "surrogateescape")
        if not hmac.compare_digest(received, expected):
            problem = (
                "no Authorization" if header is None else "an Authorization with another token"
            )
            raise RefusedError(
                401,
                problem,
                "Authorization: Bearer TOKEN, with the token that stands in the page's address",
                headers={"WWW-Authenticate": 'Bearer realm="smartcam"'},
            )


def _authorization(request: web.Request) -> str | None:
    header = request.headers.get("Authorization")
    if header is None and request.headers.get("Upgrade", "").lower() == "websocket":
        offered = request.headers.get("Sec-WebSocket-Protocol", "").split(",")
        tokens = [offer.strip() for offer in offered if offer.strip().startswith(BEARER)]
        return f"Bearer {tokens[0].removeprefix(BEARER)}" if tokens else None
    return header


def check_host(host: str, names: Collection[str] | None = None) -> None:
    """Refuse a request that names another machine, as DNS rebinding does.

    Args:
        host: the request's ``Host``.
        names: names of this machine, in lower case, that are allowed in addition to loopback and
            all addresses; None: only names and addresses of loopback are allowed.

    Raises:
        RefusedError: 403.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        name = ""
    if is_loopback(name) or (names is not None and (name in names or _is_address(name))):
        return
    expected = "localhost or another name of loopback"
    if names is not None:
        expected = f"an address, localhost, {', '.join(sorted(names))}, or one of operations.names"
    raise RefusedError(403, f"Host {short_repr(host)}", expected)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _check_origin(request: web.Request) -> None:
    origin = request.headers.get("Origin")
    if origin is not None and origin.partition("://")[2] != request.host:
        raise RefusedError(
            403, f"Origin {short_repr(origin)}", f"the page's own: http://{request.host}"
        )
    site = request.headers.get("Sec-Fetch-Site", "none")
    if site not in {"none", "same-origin"}:
        raise RefusedError(403, f"Sec-Fetch-Site {short_repr(site)}", "the page's own calls")


def new_token() -> str:
    """Return a new token."""
    return secrets.token_urlsafe(24)


def check_token(token: str) -> None:
    """Check a token that a user chose.

    Raises:
        ConfigurationError: the token is too short, or has characters that a header or a URL
            cannot carry.
    """
    other_characters = token.replace("-", "").replace("_", "")
    if len(token) < MIN_TOKEN_CHARACTERS or not (
        other_characters.isascii() and other_characters.isalnum()
    ):
        raise ConfigurationError(
            f"web: a token has {MIN_TOKEN_CHARACTERS} letters, digits, '-' and '_' at least, "
            f"this one has {len(token)} characters"
        )
