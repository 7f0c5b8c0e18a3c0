"""Read the section of a fleet file on access to the bus, and refuse wrong values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from smartcam._accepting import is_loopback

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

Access = Literal["roles", "any-certificate", "anyone-may-command"]

ANYONE: Access = "anyone-may-command"

CURE = "smartcam fleet certificates makes certificates: then listen: tls/..., certificates: DIR"

Mistake = tuple[tuple[str, ...], str]


def access_of(given: Access | None, listen: Sequence[str]) -> Access | None:
    """Return the effective access: with TLS roles, or any certificate could command."""
    tls = any(endpoint.startswith("tls/") for endpoint in listen)
    return given or ("roles" if tls else None)


def access_mistakes(given: Access | None, listen: Sequence[str]) -> Iterator[Mistake]:
    """Yield the mistakes in the access of a fleet file."""
    plain = [endpoint for endpoint in listen if not endpoint.startswith("tls/")]
    open_to_all = [
        endpoint for endpoint in plain if not is_loopback(endpoint[4:].rpartition(":")[0])
    ]
    access = access_of(given, listen)
    if access == "roles" and plain:
        yield (
            ("listen",),
            f"{plain[0]} asks for no certificate, so its programs have no role: expected only "
            "tls/ endpoints, or access: any-certificate",
        )
    elif access != ANYONE and open_to_all:
        yield (
            ("listen",),
            f"{open_to_all[0]} accepts every program without a certificate, and each may command "
            f"the cameras. {CURE}. If this is wanted: access: {ANYONE}",
        )
    elif given in {"roles", "any-certificate"} and listen and len(plain) == len(listen):
        yield ("access",), f"{given} needs listen: tls/... and certificates"
