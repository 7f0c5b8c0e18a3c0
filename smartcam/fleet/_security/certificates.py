"""Read certificates (owner, role, expiry), and find out why a TLS handshake failed."""

from __future__ import annotations

import asyncio
import hashlib
import os
import ssl
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._extras import load
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._bus.address import CERTIFICATE_FILES

if TYPE_CHECKING:
    from pathlib import Path

    from cryptography import x509

VIEWER, OPERATOR, AGENT, ROUTER = ROLES = ("viewer", "operator", "agent", "router")
"""The possible common names of a certificate."""

MAX_BYTES = 1 << 20
"""Largest number of bytes of a file with certificates or a key; each certificate has about 1 kB."""

WARN_BEFORE = (timedelta(days=30), timedelta(days=7))
"""Remaining lifetimes of a certificate at which a warning is logged."""

DAY = timedelta(days=1)

DIAGNOSIS_TIMEOUT = 1.0
"""Seconds for finding out why a handshake failed."""

RENEW = "smartcam fleet certificates DIR makes a new one"

VERIFY_TEXTS: dict[int, str] = {
    9: "its certificate is not valid yet: check the clocks of both computers",
    10: "its certificate has expired",
    18: "its certificate is of another authority than ca.pem",
    19: "its certificate is of another authority than ca.pem",
    20: "its certificate is of another authority than ca.pem",
    21: "its certificate is of another authority than ca.pem",
    62: "its certificate is for other hosts than {host}; smartcam fleet certificates takes --host",
    64: "its certificate is for other hosts than {host}; smartcam fleet certificates takes --host",
}
"""Texts for OpenSSL's errors of verification (X509_V_ERR_...), by their numbers."""

REASON_TEXTS: dict[str, str] = {
    "CERTIFICATE_REQUIRED": "it wants a certificate of this program",
    "HANDSHAKE_FAILURE": "it wants a certificate of this program",
    "UNKNOWN_CA": "the certificate of this program is of an authority that it does not know",
    "DECRYPT_ERROR": "the certificate of this program is of an authority that it does not know",
    "CERTIFICATE_EXPIRED": "the certificate of this program has expired, by its clock",
    "BAD_CERTIFICATE": "it does not take the certificate of this program",
    "WRONG_VERSION_NUMBER": "nothing there speaks TLS: is it fleet://, without +tls?",
    "RECORD_LAYER_FAILURE": "nothing there speaks TLS: is it fleet://, without +tls?",
}
"""Texts for OpenSSL's reasons of other errors, by the end of the reason."""


SILENT = "nothing there answers a TLS handshake: is it fleet://, without +tls?"


class Identity(NamedTuple):
    """The owner of a certificate.

    Attributes:
        folder: folder of the certificate.
        role: common name in the certificate.
        name: organisational unit in the certificate; empty if there is none.
        expires_at: time at which the certificate expires, UTC.
        authority_expires_at: time at which its authority's certificate expires, UTC.
        digest: digest of the contents of all three files.
    """

    folder: Path
    role: str
    name: str
    expires_at: datetime
    authority_expires_at: datetime
    digest: bytes

    def __str__(self) -> str:
        return f"{self.role} {self.name}".strip()

    @property
    def expired_text(self) -> str:
        """Text which says that a certificate has expired; empty if none has."""
        now = datetime.now(UTC)
        for certificate, expires_at in self._expiries:
            if now >= expires_at:
                return f"{certificate} has expired on {_day(expires_at)}; {RENEW}"
        return ""

    @property
    def warning(self) -> str:
        """Text which says that a certificate ends soon, or has expired; empty otherwise."""
        return self.expired_text or expiry_warning(
            *min(self._expiries, key=lambda ending: ending[1])
        )

    @property
    def urgency(self) -> int:
        """Number of past warning times; one more when the certificate has expired."""
        return sum(self._time_left <= limit for limit in (*WARN_BEFORE, timedelta()))

    @property
    def next_check_delay(self) -> float:
        """Seconds until the next warning may be due; at most a day, as the files may be renewed."""
        times = [
            self._time_left - limit
            for limit in (*WARN_BEFORE, timedelta())
            if self._time_left > limit
        ]
        return min([DAY, *times]).total_seconds() + 0.1

    @property
    def _time_left(self) -> timedelta:
        return min(self.expires_at, self.authority_expires_at) - datetime.now(UTC)

    @property
    def _expiries(self) -> tuple[tuple[str, datetime], ...]:
        own_text = f"the certificate of {self} ({self.folder / CERTIFICATE_FILES[1]})"
        authority_text = f"that of its authority ({self.folder / CERTIFICATE_FILES[0]})"
        return (own_text, self.expires_at), (authority_text, self.authority_expires_at)


def expiry_warning(certificate: str, expires_at: datetime | None) -> str:
    """Return a text which says that a certificate ends soon; empty if it does not."""
    if expires_at is None or (remaining := expires_at - datetime.now(UTC)) > WARN_BEFORE[0]:
        return ""
    return f"{certificate} ends on {_day(expires_at)}, in {_span(remaining)}; {RENEW}"


def may_command(role: str) -> bool:
    """Return True for operators, and for roles that are not smartcam's."""
    return role not in ROLES or role == OPERATOR


def _day(when: datetime) -> str:
    return f"{when:%Y-%m-%d %H:%M} UTC"


def _span(remaining: timedelta) -> str:
    return (
        f"{remaining.days} days"
        if remaining.days > 1
        else f"{remaining.total_seconds() / 3600:.2g} hours"
    )


def x509_module() -> Any:
    """Return the module that reads certificates.

    Raises:
        MissingExtraError: the package is not installed.
    """
    return load("cryptography.x509")


def read_identity(folder: Path) -> Identity:
    """Read the identity in a folder's certificate; blocks for some milliseconds.

    Raises:
        ConfigurationError: the files are not valid, or do not belong together.
        MissingExtraError: cryptography is not installed.
    """
    x509 = x509_module()
    bodies: list[bytes] = []
    for name in CERTIFICATE_FILES:
        try:
            with (folder / name).open("rb") as stream:
                bodies.append(stream.read(MAX_BYTES + 1))
        except OSError as exc:
            raise ConfigurationError(f"certificates: {folder / name}: {exc.strerror}") from exc
        if len(bodies[-1]) > MAX_BYTES:
            raise ConfigurationError(
                f"certificates: {folder / name}: expected {MAX_BYTES} bytes at most, got more"
            )
    try:
        certificate = x509.load_pem_x509_certificate(bodies[1])
        authorities = x509.load_pem_x509_certificates(bodies[0])
    except ValueError as exc:
        raise ConfigurationError(f"certificates: {folder}: no certificate: {exc}") from exc
    try:  # check that certificate and key belong together
        tls_context(folder)
    except (ssl.SSLError, OSError) as exc:
        raise ConfigurationError(
            f"certificates: {folder}: cert.pem and key.pem do not go together: {exc}"
        ) from exc
    oid = x509.NameOID
    return Identity(
        folder,
        _subject_attribute(certificate, oid.COMMON_NAME),
        _subject_attribute(certificate, oid.ORGANIZATIONAL_UNIT_NAME),
        certificate.not_valid_after_utc,
        max(authority.not_valid_after_utc for authority in authorities),
        hashlib.sha256(b"\0".join(bodies)).digest(),
    )


def _subject_attribute(certificate: x509.Certificate, oid: Any) -> str:
    attributes = certificate.subject.get_attributes_for_oid(oid)
    return str(attributes[0].value) if attributes else ""


def tls_context(folder: Path) -> ssl.SSLContext:
    """Return the TLS context for a handshake with the certificates of a folder; blocks.

    Raises:
        ssl.SSLError: the files are not certificates.
    """
    ca, cert, key = (folder / name for name in CERTIFICATE_FILES)
    context = ssl.create_default_context(cafile=str(ca))
    context.verify_flags &= ~ssl.VERIFY_X509_STRICT  # nor is Zenoh's TLS strict
    context.load_cert_chain(cert, key, password="")  # without a password, OpenSSL would ask for one
    return context


class Handshake(NamedTuple):
    """The outcome of a handshake.

    Attributes:
        trouble: reason why the handshake failed; empty if it succeeded.
        expires_at: time at which the other side's certificate expires, UTC; None if it sent none.
    """

    trouble: str
    expires_at: datetime | None


async def shake_hands(
    host: str, port: int, folder: Path, timeout: float = DIAGNOSIS_TIMEOUT
) -> Handshake:
    """Try a handshake for at most ``timeout`` seconds, and return its outcome."""
    loop = asyncio.get_running_loop()
    writer: asyncio.StreamWriter | None = None
    expires_at: datetime | None = None
    try:
        async with asyncio.timeout(timeout):
            context = await loop.run_in_executor(None, tls_context, folder)
            reader, writer = await asyncio.open_connection(host, port, ssl=context)
            peer: Any = writer.get_extra_info("peercert") or {}
            if "notAfter" in peer:
                expires_at = datetime.fromtimestamp(ssl.cert_time_to_seconds(peer["notAfter"]), UTC)
            await reader.read(1)  # an endpoint that refuses the certificate reports it now
    except TimeoutError:  # an endpoint that waits for data has accepted it
        return Handshake(SILENT if writer is None else "", expires_at)
    except ssl.SSLCertVerificationError as exc:
        why = VERIFY_TEXTS.get(
            exc.verify_code, f"its certificate is not good: {exc.verify_message}"
        )
        return Handshake(why.format(host=host), expires_at)
    except ssl.SSLError as exc:
        reason = exc.reason or str(exc)
        texts = (text for end, text in REASON_TEXTS.items() if reason.endswith(end))
        return Handshake(next(texts, f"TLS: {reason}"), expires_at)
    except OSError as exc:
        return Handshake(os.strerror(exc.errno) if exc.errno else str(exc), expires_at)
    finally:
        if writer is not None:
            writer.transport.abort()
    return Handshake("", expires_at)
