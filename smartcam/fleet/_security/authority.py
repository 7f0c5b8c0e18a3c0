"""Make certificates with a plant's own certificate authority, whose files are in a folder."""

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
"""Name of the folder of the authority's own files; no certificate can have this name."""

CA_FILE, CERT_FILE, KEY_FILE = CERTIFICATE_FILES

HOW_TO_USE = "how-to-use.txt"
ROUTER_FILE = "router.json5"

LIFETIME = timedelta(days=365)
AUTHORITY_LIFETIME = timedelta(days=3650)

RENEWAL_TIME = timedelta(days=30)
"""A certificate is renewed when less than this remains of its lifetime, or less than a third of its
lifetime if that is shorter."""

START_MARGIN = timedelta(days=1)
"""Time by which a certificate's validity begins before now, since clocks in a plant differ."""

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
"""Hosts in every agent's certificate."""

HOST = re.compile(r"[\w.:-]+", re.ASCII)

LISTENING_ROLES = frozenset({AGENT, ROUTER})


class MadeCertificate(NamedTuple):
    """The outcome for one certificate.

    Attributes:
        role: role of the certificate.
        name: name in the certificate.
        folder: folder of the certificate.
        done: ``made``, ``renewed`` or ``kept``.
        expires_at: time at which the certificate expires, UTC.
        use: lines for fleet.yaml, or the URL to use.
    """

    role: str
    name: str
    folder: str
    done: str
    expires_at: datetime
    use: str


def make_certificates(
    folder: Path,
    wanted: Mapping[str, Iterable[str]],
    *,
    hosts: Iterable[str] = (),
    lifetime: timedelta = LIFETIME,
) -> list[MadeCertificate]:
    """Make a plant's missing certificates, and renew those that expire soon. This call blocks.

    Each certificate has a folder with ``ca.pem``, ``cert.pem``, ``key.pem`` (mode 0600) and a text
    on its use. The first call makes the authority, in ``authority``. A renewed certificate keeps
    its key, so only one file is replaced, in one step.

    Args:
        folder: folder of the plant's certificates.
        wanted: names by role.
        hosts: names and addresses of agents and routers, in addition to this computer's own. An
            agent of ``wanted`` whose certificate lacks one of them gets a new certificate.
        lifetime: lifetime of new certificates; they end with the authority's certificate at the
            latest.

    Raises:
        ConfigurationError: a name is not valid, or is another role's; the authority is not
            complete, or a file cannot be written.
    """
    x509_module()
    names: dict[str, str] = {}
    for role, names_of_role in wanted.items():
        for name in names_of_role:
            if check_word(name, role) == AUTHORITY or names.setdefault(name, role) != role:
                raise ConfigurationError(f"certificates: {name} is taken: expected another name")
    unique_hosts = [*dict.fromkeys(hosts)]
    for host in unique_hosts:
        if not HOST.fullmatch(host):
            raise ConfigurationError(f"certificates: {host!r:.80} is no name or address of a host")
    authority = _Authority.open_or_create(folder)
    roles: dict[str, str] = {}
    for subfolder in sorted(folder.iterdir()):
        if subfolder.name != AUTHORITY and (subfolder / CERT_FILE).is_file():
            roles[subfolder.name] = authority.read_role(subfolder)
    for name, role in names.items():
        if roles.setdefault(name, role) != role:
            raise ConfigurationError(
                f"certificates: {name} has the role {roles[name]} already: expected another name "
                f"for the {role}, or delete {folder / name}"
            )
    return [
        authority.make_certificate(role, name, unique_hosts if name in names else [], lifetime)
        for name, role in sorted(roles.items())
    ]


class _Authority:
    """The authority, which signs certificates.

    Args:
        folder: folder of the plant's certificates.
    """

    def __init__(self, folder: Path, certificate: Any, key: Any) -> None:
        self._folder, self._certificate, self._key = folder, certificate, key

    @classmethod
    def open_or_create(cls, folder: Path) -> _Authority:
        """Return the authority of a folder; make one if there is none."""
        from cryptography import x509

        own_folder = folder / AUTHORITY
        has_authority = (own_folder / CA_FILE).exists()
        is_foreign = (folder / CA_FILE).exists()
        if is_foreign or (has_authority and not (own_folder / KEY_FILE).exists()):
            raise ConfigurationError(
                f"certificates: {(folder if is_foreign else own_folder) / CA_FILE} is of an "
                f"authority whose key is not in {own_folder}, and it is not overwritten: expected "
                "a folder that this command made, or an empty one"
            )
        if not has_authority:
            cls._create(own_folder)
        try:
            certificate = x509.load_pem_x509_certificate((own_folder / CA_FILE).read_bytes())
        except (OSError, ValueError) as exc:
            raise ConfigurationError(
                f"certificates: {own_folder / CA_FILE} cannot be read: {exc}"
            ) from exc
        return cls(folder, certificate, _load_or_make_key(own_folder))

    @staticmethod
    def _create(folder: Path) -> None:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes

        key = _load_or_make_key(folder)
        name = _subject("smartcam plant", "")
        certificate = (
            _builder(name, name, key.public_key(), datetime.now(UTC) + AUTHORITY_LIFETIME)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_key_usage(signs=True), critical=True)
            .sign(key, hashes.SHA256())
        )
        _write(folder / CA_FILE, _pem(certificate))

    def read_role(self, folder: Path) -> str:
        """Return the role in the certificate of a folder."""
        identity = read_identity(folder)
        if identity.role not in ROLES:
            raise ConfigurationError(
                f"certificates: {folder} has a certificate with the role "
                f"{identity.role!r:.40}: expected one of {', '.join(ROLES)}"
            )
        return identity.role

    def make_certificate(
        self, role: str, name: str, hosts: list[str], lifetime: timedelta
    ) -> MadeCertificate:
        """Make the certificate of a name, or renew it, if needed; return the outcome."""
        folder = self._folder / name
        certificate = self._read_certificate(folder)
        done = "kept"
        if role in LISTENING_ROLES:
            old_hosts = [] if certificate is None else _hosts_of(certificate)
            wanted = [*LOCAL_HOSTS, *(hosts or ([] if old_hosts else [socket.gethostname()]))]
            hosts = [*dict.fromkeys([*old_hosts, *wanted])]
            lacks_hosts = bool({*hosts} - {*old_hosts})
        else:
            hosts, lacks_hosts = [], False
        if certificate is None or lacks_hosts or _expires_soon(certificate):
            done = "made" if certificate is None else "renewed"
            certificate = self._sign(role, name, hosts, lifetime, folder)
        use = _usage_text(role, name, folder, hosts)
        if role == ROUTER and not (folder / ROUTER_FILE).exists():
            _write(folder / ROUTER_FILE, _router_config(folder))
        if not (folder / HOW_TO_USE).exists():
            _write(folder / HOW_TO_USE, use.encode())
        return MadeCertificate(role, name, str(folder), done, certificate.not_valid_after_utc, use)

    def _read_certificate(self, folder: Path) -> Any:
        from cryptography import x509

        if not (folder / CERT_FILE).is_file():
            return None
        certificate = x509.load_pem_x509_certificate((folder / CERT_FILE).read_bytes())
        try:
            certificate.verify_directly_issued_by(self._certificate)
        except Exception as exc:  # InvalidSignature, ValueError, TypeError: another authority's
            raise ConfigurationError(
                f"certificates: {folder / CERT_FILE} is of another authority than "
                f"{self._folder / AUTHORITY}: expected one of this authority, or no file"
            ) from exc
        return certificate

    def _sign(
        self, role: str, name: str, hosts: list[str], lifetime: timedelta, folder: Path
    ) -> Any:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes
        from cryptography.x509.oid import ExtendedKeyUsageOID

        key = _load_or_make_key(folder)
        expires_at = min(datetime.now(UTC) + lifetime, self._certificate.not_valid_after_utc)
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if role in LISTENING_ROLES:  # other certificates cannot serve as an agent's
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        subject, issuer = _subject(role, name), self._certificate.subject
        builder = (
            _builder(subject, issuer, key.public_key(), expires_at)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .add_extension(identifier, critical=False)
        )
        if hosts:
            names = x509.SubjectAlternativeName([_general_name(host) for host in hosts])
            builder = builder.add_extension(names, critical=False)
        certificate = builder.sign(self._key, hashes.SHA256())
        _write(folder / CA_FILE, _pem(self._certificate))
        _write(folder / CERT_FILE, _pem(certificate))
        return certificate


def _load_or_make_key(folder: Path) -> Any:
    """Return the key in a folder; make a new key if there is none."""
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    path = folder / KEY_FILE
    if not path.is_file():
        key = ec.generate_private_key(ec.SECP256R1())
        _write_key(folder, key)
        return key
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


def _builder(subject: Any, issuer: Any, key: Any, expires_at: datetime) -> Any:
    from cryptography import x509

    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.now(UTC) - START_MARGIN)
        .not_valid_after(expires_at)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _key_usage(*, signs: bool) -> Any:
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


def _general_name(host: str) -> Any:
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


def _expires_soon(certificate: Any) -> bool:
    expires_at, begins = certificate.not_valid_after_utc, certificate.not_valid_before_utc
    lifetime = expires_at - begins - START_MARGIN
    return bool(expires_at - datetime.now(UTC) <= min(RENEWAL_TIME, lifetime / 3))


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


def _write_key(folder: Path, key: Any) -> None:
    """Write a new key to a file that only its owner can ever read."""
    from cryptography.hazmat.primitives import serialization

    body = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        with os.fdopen(os.open(folder / KEY_FILE, flags, 0o600), "wb") as file:
            file.write(body)
            file.flush()
            os.fsync(file.fileno())
    except OSError as exc:
        raise ConfigurationError(
            f"certificates: {folder / KEY_FILE} cannot be written: {exc.strerror}"
        ) from exc


def _usage_text(role: str, name: str, folder: Path, hosts: list[str]) -> str:
    """Return a text on how to use a certificate."""
    host = next((host for host in reversed(hosts) if host not in LOCAL_HOSTS), "HOST")
    if role == ROUTER:
        return f"zenohd --config {folder / ROUTER_FILE}\n"
    if role == AGENT:
        return (
            "# in fleet.yaml\n"
            f"agent: {name}\n"
            f"listen: tls/0.0.0.0:{DEFAULT_PORT}  # or connect: tls/HOST:{DEFAULT_PORT}\n"
            f"certificates: {folder}  # this folder, where it is on the agent's host\n"
            "access: roles\n"
            f"# programs find it at {host}, port {DEFAULT_PORT}\n"
        )
    return (
        f"fleet+tls://HOST:{DEFAULT_PORT}/CAMERA?certificates={folder}\n"
        f"# or SMARTCAM_FLEET_CERTIFICATES={folder}\n"
    )


def _router_config(folder: Path) -> bytes:
    """Return a complete configuration of Zenoh's own router."""
    link = BusLink((f"tls/0.0.0.0:{DEFAULT_PORT}",), (), str(folder.absolute()))
    config: dict[str, Any] = {"access_control": access_control()}
    for path, value in link.settings(10.0).items():
        section = config
        *names, last = path.split("/")
        for name in names:
            section = section.setdefault(name, {})
        section[last] = value
    return json.dumps(config, indent=2).encode()
