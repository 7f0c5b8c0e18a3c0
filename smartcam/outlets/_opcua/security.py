"""Control access to the server: users, certificates, and rights of anonymous clients."""

from __future__ import annotations

import collections
import contextlib
import hmac
import os
import socket
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto import cert_gen
from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions
from asyncua.server.internal_server import InternalServer
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from smartcam.outlets._opcua.settings import OpcUaSettings

CERTIFICATE_DAYS = 3650
"""Number of days for which a certificate that the server makes is valid."""

MAX_FAILED_LOGINS = 10
"""Number of failed logins within FAILED_LOGIN_TIME after which an address is refused."""

FAILED_LOGIN_TIME = 60.0
"""Seconds for which a failed login counts."""

MAX_ADDRESSES = 1000
"""Largest number of addresses whose failed logins are counted; the oldest are dropped."""

_SHA1 = "http://www.w3.org/2000/09/xmldsig#rsa-sha1"

_READ_SERVICES = (
    ua.ObjectIds.CreateSessionRequest_Encoding_DefaultBinary,
    ua.ObjectIds.CloseSessionRequest_Encoding_DefaultBinary,
    ua.ObjectIds.ActivateSessionRequest_Encoding_DefaultBinary,
    ua.ObjectIds.ReadRequest_Encoding_DefaultBinary,
    ua.ObjectIds.BrowseRequest_Encoding_DefaultBinary,
    ua.ObjectIds.GetEndpointsRequest_Encoding_DefaultBinary,
    ua.ObjectIds.FindServersRequest_Encoding_DefaultBinary,
    ua.ObjectIds.TranslateBrowsePathsToNodeIdsRequest_Encoding_DefaultBinary,
    ua.ObjectIds.CreateSubscriptionRequest_Encoding_DefaultBinary,
    ua.ObjectIds.ModifySubscriptionRequest_Encoding_DefaultBinary,
    ua.ObjectIds.DeleteSubscriptionsRequest_Encoding_DefaultBinary,
    ua.ObjectIds.TransferSubscriptionsRequest_Encoding_DefaultBinary,
    ua.ObjectIds.CreateMonitoredItemsRequest_Encoding_DefaultBinary,
    ua.ObjectIds.ModifyMonitoredItemsRequest_Encoding_DefaultBinary,
    ua.ObjectIds.DeleteMonitoredItemsRequest_Encoding_DefaultBinary,
    ua.ObjectIds.PublishRequest_Encoding_DefaultBinary,
    ua.ObjectIds.RepublishRequest_Encoding_DefaultBinary,
    ua.ObjectIds.CloseSecureChannelRequest_Encoding_DefaultBinary,
    ua.ObjectIds.SetMonitoringModeRequest_Encoding_DefaultBinary,
    ua.ObjectIds.SetPublishingModeRequest_Encoding_DefaultBinary,
    ua.ObjectIds.RegisterNodesRequest_Encoding_DefaultBinary,
    ua.ObjectIds.UnregisterNodesRequest_Encoding_DefaultBinary,
)
"""Services of clients that may only read."""


class Users:
    """The users of a server, in the form of asyncua's user managers.

    Args:
        settings: settings of the server.
        folder: folder to which relative paths refer.

    Raises:
        ConfigurationError: a password does not exist where the settings say.
    """

    def __init__(self, settings: OpcUaSettings, folder: Path) -> None:
        self._anonymous = settings.anonymous
        self._passwords = {name: user.read(folder) for name, user in settings.users.items()}
        for name, password in self._passwords.items():
            if not password:
                raise ConfigurationError(f"users.{name}: the password is empty")
        self._certificates = {
            _load_certificate(folder / path, name): name
            for name, path in settings.user_certificates.items()
        }
        if len(self._certificates) < len(settings.user_certificates):
            raise ConfigurationError("user_certificates: two users have the same certificate")

    def get_user(
        self,
        iserver: Any,
        username: str | None = None,
        password: str | None = None,
        certificate: Any = None,
    ) -> User | None:
        """Return the user with the user's rights; None if access is refused."""
        del iserver
        if isinstance(certificate, ProvenCertificate):
            parsed = x509.load_der_x509_certificate(certificate)
            is_valid = (
                parsed.not_valid_before_utc <= datetime.now(UTC) <= parsed.not_valid_after_utc
            )
            name = self._certificates.get(bytes(certificate))
            return User(UserRole.User, name) if name and is_valid else None
        if username is not None:
            known = self._passwords.get(username)
            sent = (password or "").encode()
            is_right = hmac.compare_digest((known or "").encode(), sent)
            return User(UserRole.User, username) if known and is_right else None
        roles = {"read": UserRole.Anonymous, "control": UserRole.User}
        role = roles.get(self._anonymous)
        return None if role is None else User(role, "anonymous")


class ProvenCertificate(bytes):
    """A certificate whose user has signed with its private key when logging in.

    The certificate of the encrypted channel, in contrast, identifies only a program.
    """


class FailedLogins:
    """Counts failed logins by address, and refuses an address that guesses passwords.

    Args:
        clock: function that returns a time in seconds, from any origin.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failed: collections.OrderedDict[str, list[float]] = collections.OrderedDict()

    @contextlib.contextmanager
    def counting_attempt(self, address: str) -> Iterator[None]:
        """Count the block as a failed login if it raises.

        Raises:
            ServiceError: too many logins from this address have failed.
        """
        now = self._clock()
        failed = [at for at in self._failed.get(address, ()) if now - at < FAILED_LOGIN_TIME]
        if len(failed) >= MAX_FAILED_LOGINS:
            raise ServiceError(ua.StatusCodes.BadUserAccessDenied)
        try:
            yield
        except Exception:
            self._failed[address] = [*failed, now]
            self._failed.move_to_end(address)
            if len(self._failed) > MAX_ADDRESSES:
                self._failed.popitem(last=False)
            raise


class GuardedServer(InternalServer):  # type: ignore[misc] # asyncua's types are not followed
    """asyncua's internal server, with a bound on failed logins.

    Args:
        users: the users.
    """

    def __init__(self, users: Users) -> None:
        super().__init__(user_manager=users)
        self.failed_logins: FailedLogins = FailedLogins()

    def decrypt_user_token(self, isession: Any, token: Any) -> tuple[str, str]:
        """Return the client's name and password; raise an error if they are wrong."""
        with self.failed_logins.counting_attempt(_address(isession)):
            name, password = super().decrypt_user_token(isession, token)
            if self.user_manager.get_user(self, name, password) is None:
                raise ServiceError(ua.StatusCodes.BadUserAccessDenied)
        return name, password

    def verify_x509_token(self, isession: Any, token: Any, signature: Any) -> ProvenCertificate:
        """Return a user's certificate; raise an error if it is unknown or its key did not sign."""
        with self.failed_logins.counting_attempt(_address(isession)):
            if signature.Algorithm == _SHA1:
                raise ServiceError(ua.StatusCodes.BadSecurityPolicyRejected)
            proven = ProvenCertificate(super().verify_x509_token(isession, token, signature))
            if self.user_manager.get_user(self, certificate=proven) is None:
                raise ServiceError(ua.StatusCodes.BadUserAccessDenied)
        return proven


def _address(isession: Any) -> str:
    """Return the address of a session's client, without its port."""
    name = isession.name
    return str(name[0] if isinstance(name, tuple) else name)


def _load_certificate(path: Path, name: str) -> bytes:
    """Return a user's certificate as DER."""
    try:
        data = path.read_bytes()
        is_pem = data.lstrip().startswith(b"-----BEGIN")
        load = x509.load_pem_x509_certificate if is_pem else x509.load_der_x509_certificate
        certificate = load(data)
    except (OSError, ValueError) as exc:
        raise ConfigurationError(f"user_certificates.{name}: {path}: {exc}") from exc
    return certificate.public_bytes(Encoding.DER)


class Rights(SimpleRoleRuleset):  # type: ignore[misc] # asyncua's types are not followed
    """The rights of users; anonymous users may only read."""

    def __init__(self) -> None:
        super().__init__()
        self._permission_dict[UserRole.Anonymous] = {*map(ua.NodeId, _READ_SERVICES)}


def login_tokens(settings: OpcUaSettings) -> list[type]:
    """Return the types of tokens by which clients may log in."""
    return [
        *([] if settings.anonymous == "no" else [ua.AnonymousIdentityToken]),
        *([ua.UserNameIdentityToken] if settings.users else []),
        *([ua.X509IdentityToken] if settings.user_certificates else []),
    ]


def security_policies(settings: OpcUaSettings) -> list[ua.SecurityPolicyType]:
    """Return the security policies that are offered."""
    policy = ua.SecurityPolicyType
    return [
        policy.Basic256Sha256_SignAndEncrypt,
        policy.Aes128Sha256RsaOaep_SignAndEncrypt,
        policy.Aes256Sha256RsaPss_SignAndEncrypt,
        *((policy.NoSecurity,) if settings.unencrypted else ()),
    ]


async def configure_security(server: Any, name: str, settings: OpcUaSettings, folder: Path) -> None:
    """Configure a server's certificate, its policies and its trusted clients.

    Raises:
        ConfigurationError: a certificate or a key does not exist, or cannot be used.
    """
    try:
        if settings.certificate is None or settings.key is None:
            own_folder = folder / settings.spool
            certificate = own_folder / f"{name}.opcua.der"
            key = own_folder / f"{name}.opcua.pem"
            if not (certificate.is_file() and key.is_file()):
                _make_certificate(certificate, key, f"urn:{socket.gethostname()}:smartcam:{name}")
        else:
            certificate, key = folder / settings.certificate, folder / settings.key
        await server.load_certificate(certificate)
        await server.load_private_key(key)
        await server.set_application_uri(_application_uri(server.iserver.certificate))
        if settings.clients is not None:
            if not (folder / settings.clients).is_dir():
                raise ValueError(f"clients: {folder / settings.clients} is no folder")
            server.set_certificate_validator(await _validator(folder / settings.clients))
    except (OSError, ValueError, x509.ExtensionNotFound) as exc:
        raise ConfigurationError(f"outlet {name}: certificate: {exc}") from exc
    server.set_security_policy(security_policies(settings), Rights())
    server.set_identity_tokens(login_tokens(settings))


def _application_uri(certificate: x509.Certificate) -> str:
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    uris = names.get_values_for_type(x509.UniformResourceIdentifier)
    if not uris:
        raise ValueError("it names no application: a URI among its alternative names is missing")
    return str(uris[0])


def _make_certificate(certificate: Path, key: Path, uri: str) -> None:
    """Make a self-signed certificate, and its key, which only this user may read."""
    private_key = cert_gen.generate_private_key()
    host = socket.gethostname()
    signed = cert_gen.generate_self_signed_app_certificate(
        private_key,
        uri.rpartition(":")[2],
        {"organizationName": "smartcam"},
        [x509.UniformResourceIdentifier(uri), x509.DNSName(host)],
        [ExtendedKeyUsageOID.SERVER_AUTH],
        days=CERTIFICATE_DAYS,
    )
    certificate.parent.mkdir(parents=True, exist_ok=True)
    handle = os.open(key, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with open(handle, "wb") as stream:  # noqa: PTH123 - of a handle
        stream.write(cert_gen.dump_private_key_as_pem(private_key))
    certificate.write_bytes(signed.public_bytes(Encoding.DER))


async def _validator(folder: Path) -> CertificateValidator:
    store = TrustStore([folder], [])
    await store.load()
    option = CertificateValidatorOptions
    checks = option.TIME_RANGE | option.URI | option.TRUSTED | option.PEER_CLIENT
    return CertificateValidator(checks, store)
