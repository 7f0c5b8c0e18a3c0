"""A plant's own certificate authority, in a folder, and its certificates."""

from __future__ import annotations

import contextlib
import ipaddress
import json
import os
import re
import socket
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._whole_files import replace_file
from smartcam._zenoh import BusLink
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._bus.address import CERTIFICATE_FILES, DEFAULT_PORT, check_word
from smartcam.fleet._security.access import access_control
from smartcam.fleet._security.certificates import AGENT, ROLES, ROUTER, read_identity, x509_module

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

AUTHORITY = "authority"
"""Folder of the authority's own files, whose name no certificate can have."""

CA_FILE, CERT_FILE, KEY_FILE = CERTIFICATE_FILES

HOW_TO_USE = "how-to-use.txt"
ROUTER_FILE = "router.json5"

LIFETIME = timedelta(days=365)
AUTHORITY_LIFETIME = timedelta(days=3650)

RENEWAL_TIME = timedelta(days=30)
"""Time before its end, or a third of its lifetime if less, at which a certificate is renewed."""

BEFORE = timedelta(days=1)
"""Time before now at which certificates begin, since clocks in a plant differ."""

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
"""Hosts in every agent's certificate."""

HOST = re.compile(r"[\w.:-]+", re.ASCII)

LISTENING = frozenset({AGENT, ROUTER})


class MadeCertificate(NamedTuple):
    """The outcome for one certificate.

    Attributes:
        role: role of the certificate.
        name: name in the certificate.
        folder: folder of the certificate.
        done: ``made``, ``renewed`` or ``kept``.
        ends: end of the certificate, UTC.
        use: lines for fleet.yaml, or the URL to use.
    """

    role: str
    name: str
    folder: str
    done: str
    ends: datetime
    use: str


def make_certificates(
    folder: Path,
    wanted: Mapping[str, Iterable[str]],
    *,
    hosts: Iterable[str] = (),
    lifetime: timedelta = LIFETIME,
) -> list[MadeCertificate]:
    """Make a plant's missing certificates, and renew certificates that end soon; blocks.

    Each has a folder with ``ca.pem``, ``cert.pem``, ``key.pem`` (mode 0600) and a text on its use.
    The authority is made the first time, in ``authority``, and never again. A renewed certificate
    keeps its key, so that one file is replaced, in one step.

    Args:
        folder: folder of the plant's certificates.
        wanted: names by role.
        hosts: names and addresses of agents and routers, besides this computer's own; an agent of
            ``wanted`` without one of them gets a new certificate.
        lifetime: lifetime of new certificates, which ends with the authority's at the latest.

    Raises:
        ConfigurationError: a name is not valid, or is another role's; the authority is not
            complete, or a file cannot be written.
    """
    x509_module()
    names: dict[str, str] = {}
    for role, several in wanted.items():
        for name in several:
            if check_word(name, role) == AUTHORITY or names.setdefault(name, role) != role:
                raise ConfigurationError(f"certificates: {name} is taken: expected another name")
    unique_hosts = [*dict.fromkeys(hosts)]
    for host in unique_hosts:
        if not HOST.fullmatch(host):
            raise ConfigurationError(f"certificates: {host!r:.80} is no name or address of a host")
    authority = _Authority.of(folder)
    known: dict[str, str] = {}
    for place in sorted(folder.iterdir()):
        if place.name != AUTHORITY and (place / CERT_FILE).is_file():
            known[place.name] = authority.read(place).role
    for name, role in names.items():
        if known.setdefault(name, role) != role:
            raise ConfigurationError(
                f"certificates: {name} has the role {known[name]} already: expected another name "
                f"for the {role}, or delete {folder / name}"
            )
    return [
        authority.make(role, name, unique_hosts if name in names else [], lifetime)
        for name, role in sorted(known.items())
    ]


class _Authority:
    """The authority, which signs certificates.

    Args:
        folder: folder of the plant's certificates.
    """

    def __init__(self, folder: Path, certificate: Any, key: Any) -> None:
        self._folder, self._certificate, self._key = folder, certificate, key

    @classmethod
    def of(cls, folder: Path) -> _Authority:
        """Return the authority of a folder; make one if there is none."""
        from cryptography import x509

        place = folder / AUTHORITY
        has_authority = (place / CA_FILE).exists()
        foreign = (folder / CA_FILE).exists()
        if foreign or (has_authority and not (place / KEY_FILE).exists()):
            raise ConfigurationError(
                f"certificates: {(folder if foreign else place) / CA_FILE} is of an authority "
                f"whose key is not in {place}, and it is not overwritten: expected a folder that "
                "this command made, or an empty one"
            )
        if not has_authority:
            cls._create(place)
        try:
            made = x509.load_pem_x509_certificate((place / CA_FILE).read_bytes())
        except (OSError, ValueError) as exc:
            raise ConfigurationError(
                f"certificates: {place / CA_FILE} cannot be read: {exc}"
            ) from exc
        return cls(folder, made, _key_in(place))

    @staticmethod
    def _create(place: Path) -> None:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes

        key = _key_in(place)
        name = _subject("smartcam plant", "")
        made = (
            _builder(name, name, key.public_key(), datetime.now(UTC) + AUTHORITY_LIFETIME)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs=True), critical=True)
            .sign(key, hashes.SHA256())
        )
        _write(place / CA_FILE, _pem(made))

    def read(self, place: Path) -> Any:
        """Return the identity in the certificate of a folder."""
        identity = read_identity(place)
        if identity.role not in ROLES:
            raise ConfigurationError(
                f"certificates: {place} has one with the role {identity.role!r:.40}: expected one "
                f"of {', '.join(ROLES)}"
            )
        return identity

    def make(self, role: str, name: str, hosts: list[str], lifetime: timedelta) -> MadeCertificate:
        """Return the certificate of a name; it is made, or renewed, if needed."""
        place = self._folder / name
        old = self._old(place)
        done = "kept"
        if role in LISTENING:
            had = [] if old is None else _hosts_of(old)
            wanted = [*LOCAL_HOSTS, *(hosts or ([] if had else [socket.gethostname()]))]
            hosts = [*dict.fromkeys([*had, *wanted])]
            stale = bool({*hosts} - {*had})
        else:
            hosts, stale = [], False
        if old is None or stale or _ends_soon(old):
            done = "made" if old is None else "renewed"
            old = self._sign(role, name, hosts, lifetime, place)
        use = _use(role, name, place, hosts)
        if role == ROUTER and not (place / ROUTER_FILE).exists():
            _write(place / ROUTER_FILE, _router(place))
        if not (place / HOW_TO_USE).exists():
            _write(place / HOW_TO_USE, use.encode())
        return MadeCertificate(role, name, str(place), done, old.not_valid_after_utc, use)

    def _old(self, place: Path) -> Any:
        from cryptography import x509

        if not (place / CERT_FILE).is_file():
            return None
        certificate = x509.load_pem_x509_certificate((place / CERT_FILE).read_bytes())
        try:
            certificate.verify_directly_issued_by(self._certificate)
        except Exception as exc:  # InvalidSignature, ValueError, TypeError: another authority's
            raise ConfigurationError(
                f"certificates: {place / CERT_FILE} is of another authority than "
                f"{self._folder / AUTHORITY}: expected one of it, or none"
            ) from exc
        return certificate

    def _sign(
        self, role: str, name: str, hosts: list[str], lifetime: timedelta, place: Path
    ) -> Any:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes
        from cryptography.x509.oid import ExtendedKeyUsageOID

        key = _key_in(place)
        ends = min(datetime.now(UTC) + lifetime, self._certificate.not_valid_after_utc)
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if role in LISTENING:  # so that no other certificate can serve as an agent's
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        subject, issuer = _subject(role, name), self._certificate.subject
        builder = (
            _builder(subject, issuer, key.public_key(), ends)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .add_extension(identifier, critical=False)
        )
        if hosts:
            names = x509.SubjectAlternativeName([_general(host) for host in hosts])
            builder = builder.add_extension(names, critical=False)
        made = builder.sign(self._key, hashes.SHA256())
        _write(place / CA_FILE, _pem(self._certificate))
        _write(place / CERT_FILE, _pem(made))
        return made


def _key_in(place: Path) -> Any:
    """Return the key of a folder; make one if there is none."""
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    path = place / KEY_FILE
    if not path.is_file():
        made = ec.generate_private_key(ec.SECP256R1())
        _write_key(place, made)
        return made
    try:
        return serialization.load_pem_private_key(path.read_bytes(), None)
    except (OSError, ValueError, TypeError) as exc:
        raise ConfigurationError(f"certificates: {path} cannot be read: {exc}") from exc


def _subject(common: str, unit: str) -> Any:
    from cryptography import x509

    attributes = [x509.NameAttribute(x509.NameOID.COMMON_NAME, common)]
    if unit:
        attributes.append(x509.NameAttribute(x509.NameOID.ORGANIZATIONAL_UNIT_NAME, unit))
    return x509.Name(attributes)


def _builder(subject: Any, issuer: Any, key: Any, ends: datetime) -> Any:
    from cryptography import x509

    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.now(UTC) - BEFORE)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _usage(*, signs: bool) -> Any:
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=not signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )


def _general(host: str) -> Any:
    from cryptography import x509

    with contextlib.suppress(ValueError):
        return x509.IPAddress(ipaddress.ip_address(host))
    return x509.DNSName(host)


def _hosts_of(certificate: Any) -> list[str]:
    from cryptography import x509

    try:
        extension = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound:
        return []
    return [str(name.value) for name in extension.value]


def _ends_soon(certificate: Any) -> bool:
    ends, begins = certificate.not_valid_after_utc, certificate.not_valid_before_utc
    lifetime = ends - begins - BEFORE
    return bool(ends - datetime.now(UTC) <= min(RENEWAL_TIME, lifetime / 3))


def _pem(certificate: Any) -> bytes:
    from cryptography.hazmat.primitives.serialization import Encoding

    return bytes(certificate.public_bytes(Encoding.PEM))


def _write(path: Path, body: bytes) -> None:
    try:
        replace_file(path, body)
    except OSError as exc:
        raise ConfigurationError(
            f"certificates: {path} cannot be written: {exc.strerror or exc}"
        ) from exc


def _write_key(place: Path, key: Any) -> None:
    """Write a new key, which only its owner may read from its first byte on."""
    from cryptography.hazmat.primitives import serialization

    body = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        with os.fdopen(os.open(place / KEY_FILE, flags, 0o600), "wb") as file:
            file.write(body)
            file.flush()
            os.fsync(file.fileno())
    except OSError as exc:
        raise ConfigurationError(
            f"certificates: {place / KEY_FILE} cannot be written: {exc.strerror}"
        ) from exc


def _use(role: str, name: str, place: Path, hosts: list[str]) -> str:
    """Return a text on how to use a certificate."""
    host = next((host for host in reversed(hosts) if host not in LOCAL_HOSTS), "HOST")
    if role == ROUTER:
        return f"zenohd --config {place / ROUTER_FILE}\n"
    if role == AGENT:
        return (
            "# in fleet.yaml\n"
            f"agent: {name}\n"
            f"listen: tls/0.0.0.0:{DEFAULT_PORT}  # or connect: tls/HOST:{DEFAULT_PORT}\n"
            f"certificates: {place}  # this folder, where it is on the agent's host\n"
            "access: roles\n"
            f"# programs find it at {host}, port {DEFAULT_PORT}\n"
        )
    return (
        f"fleet+tls://HOST:{DEFAULT_PORT}/CAMERA?certificates={place}\n"
        f"# or SMARTCAM_FLEET_CERTIFICATES={place}\n"
    )


def _router(place: Path) -> bytes:
    """Return a complete configuration of Zenoh's own router."""
    link = BusLink((f"tls/0.0.0.0:{DEFAULT_PORT}",), (), str(place.absolute()))
    wanted = {"access_control": access_control()}
    for path, value in link.settings(10.0).items():
        inner: dict[str, Any] = wanted
        *above, last = path.split("/")
        for part in above:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return json.dumps(wanted, indent=2).encode()
