"""Check the setting ``access`` of a fleet file: who may use the bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from smartcam._accepting import is_loopback

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

Access = Literal["roles", "any-certificate", "anyone-may-command"]

ANYONE: Access = "anyone-may-command"

CURE = "Run `smartcam fleet certificates`, then set `listen: tls/...` and `certificates: DIR`"

Mistake = tuple[tuple[str, ...], str]


def effective_access(access: Access | None, listen: Sequence[str]) -> Access | None:
    """Return the effective ``access`` of a fleet file; default: ``roles`` if it has TLS."""
    tls = any(endpoint.startswith("tls/") for endpoint in listen)
    return access or ("roles" if tls else None)


def access_mistakes(access: Access | None, listen: Sequence[str]) -> Iterator[Mistake]:
    """Yield the mistakes in the setting ``access`` of a fleet file."""
    plain = [endpoint for endpoint in listen if not endpoint.startswith("tls/")]
    open_to_all = [
        endpoint for endpoint in plain if not is_loopback(endpoint[4:].rpartition(":")[0])
    ]
    effective = effective_access(access, listen)
    if effective == "roles" and plain:
        yield (
            ("listen",),
            f"{plain[0]} asks for no certificate, so its programs have no role: expected only "
            "tls/ endpoints, or access: any-certificate",
        )
    elif effective != ANYONE and open_to_all:
        yield (
            ("listen",),
            f"{open_to_all[0]} accepts every program without a certificate, and each may command "
            f"the cameras. {CURE}. If this is wanted: access: {ANYONE}",
        )
    elif access in {"roles", "any-certificate"} and listen and len(plain) == len(listen):
        yield ("access",), f"{access} needs listen: tls/... and certificates"
