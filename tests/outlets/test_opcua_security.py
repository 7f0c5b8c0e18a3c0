"""Users of a server of OPC UA, and a fleet's cameras in one server."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("asyncua")

from asyncua import Client, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.cert_gen import (
    dump_private_key_as_pem,
    generate_private_key,
    generate_self_signed_app_certificate,
)
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID

from smartcam.exceptions import ConfigurationError
from smartcam.fleet import FleetServer, load_fleet
from smartcam.fleet._inside import FleetOutlets
from smartcam.outlets import Outlets
from tests.outlets.opcuakit import Plc, cell, free_port, plc
from tests.outlets.outletkit import until

pytestmark = pytest.mark.real_time

URI = "urn:test:plc"


@pytest.fixture(scope="module")
def identity(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a client's certificate and key."""
    folder = tmp_path_factory.mktemp("identity")
    key = generate_private_key()
    names: list[Any] = [x509.UniformResourceIdentifier(URI), x509.DNSName(socket.gethostname())]
    made = generate_self_signed_app_certificate(
        key, "plc", {}, names, [ExtendedKeyUsageOID.CLIENT_AUTH]
    )
    (folder / "key.pem").write_bytes(dump_private_key_as_pem(key))
    (folder / "plc.der").write_bytes(made.public_bytes(Encoding.DER))
    return folder


def user_files(folder: Path, name: str, days: int = 10) -> Path:
    """Make a user's certificate and key in a folder, and return the folder."""
    folder.mkdir()
    key = generate_private_key()
    made = generate_self_signed_app_certificate(
        key, name, {}, [], [ExtendedKeyUsageOID.CLIENT_AUTH], days=days
    )
    (folder / "key.pem").write_bytes(dump_private_key_as_pem(key))
    (folder / "user.der").write_bytes(made.public_bytes(Encoding.DER))
    (folder / "user.pem").write_bytes(made.public_bytes(Encoding.PEM))
    return folder


async def come_in(
    url: str,
    identity: Path | None,
    user: str = "",
    password: str = "",
    certificate: tuple[Path, Path] | None = None,
) -> tuple[Client, str]:
    """Try to come in, and return the client and the error's name; "" for none.

    Args:
        url: the server's address.
        identity: folder of the client's own certificate; None for no encryption.
        user: name of the user.
        password: password of the user.
        certificate: files of the user's certificate and key.
    """
    client = Client(url, timeout=60)
    client.application_uri = URI
    if identity is not None:
        await client.set_security(
            SecurityPolicyBasic256Sha256, str(identity / "plc.der"), str(identity / "key.pem")
        )
    if user:
        client.set_user(user)
        client.set_password(password)
    if certificate is not None:
        await client.load_client_certificate(str(certificate[0]))
        await client.load_private_key(certificate[1])
    try:
        await client.connect()
    except (TimeoutError, ua.UaError, OSError) as exc:
        return client, type(exc).__name__
    return client, ""


@pytest.mark.long
async def test_users_come_in_encrypted_and_nobody_else(
    tmp_path: Path, identity: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG", "smartcam")
    caplog.set_level("DEBUG", "asyncua.server")
    (tmp_path / "word").write_text("geheim\n")
    (tmp_path / "trusted").mkdir()
    certificate = tmp_path / "trusted" / "plc.der"
    certificate.write_bytes((identity / "plc.der").read_bytes())
    rules: dict[str, Any] = {"anonymous": "no", "unencrypted": False, "clients": "trusted"}
    async with cell(tmp_path, **rules, users={"plc": {"file": "word"}}) as there:
        client, error = await come_in(there.url, identity, "plc", "geheim")
        assert error == ""
        known = Plc(client)
        await known.learn()
        await known.wait_for("Ready")
        await known.start_job("encrypted")
        await client.disconnect()
        for user, password in (("plc", "wrong"), ("other", "geheim"), ("", "")):
            assert (await come_in(there.url, identity, user, password))[1]
        assert (await come_in(there.url, None, "plc", "geheim"))[1]
        assert "geheim" not in caplog.text
        key = tmp_path / "outlets" / "opcua.opcua.pem"
        assert key.stat().st_mode & 0o077 == 0


@pytest.mark.long
async def test_users_come_in_with_certificates_of_their_own(tmp_path: Path, identity: Path) -> None:
    known, other = user_files(tmp_path / "known", "plc"), user_files(tmp_path / "other", "plc")
    old = user_files(tmp_path / "old", "old", days=0)
    users = {"plc": "known/user.pem", "old": "old/user.der"}
    rules: dict[str, Any] = {"anonymous": "read", "unencrypted": True, "user_certificates": users}

    async def jobs_of(identity: Path | None, certificate: Path, key: Path) -> str:
        """Start a job, and return why that failed; "" where it did not."""
        pair = certificate / "user.der", key / "key.pem"
        client, error = await come_in(there.url, identity, certificate=pair)
        if error:
            return error
        user = Plc(client)
        await user.learn()
        await user.wait_for("Ready")
        await user.start_job("by certificate")
        await client.disconnect()
        return ""

    async with cell(tmp_path, **rules) as there:
        assert [await jobs_of(one, known, known) for one in (identity, None)] == ["", ""]
        for certificate, key, why in (
            (other, other, "BadUserAccessDenied"),
            (old, old, "BadUserAccessDenied"),
            (known, other, "BadIdentityTokenInvalid"),
        ):
            assert await jobs_of(identity, certificate, key) == why
        reader = Plc((await come_in(there.url, identity))[0])
        await reader.learn()
        with pytest.raises(ua.UaStatusCodeError):
            await reader.start_job()
        await reader.client.disconnect()


@pytest.mark.long
async def test_passwords_are_not_tried_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLC_WORD", "geheim")
    rules: dict[str, Any] = {"anonymous": "no", "unencrypted": True}
    async with cell(tmp_path, **rules, users={"plc": {"variable": "PLC_WORD"}}) as there:
        pump: Any = there.outlets._pumps["opcua"]
        logins: Any = pump.outlet._server.server.iserver.failed_logins
        now = 0.0
        logins._clock = lambda: now
        for number in range(10):
            assert (await come_in(there.url, None, "plc", f"geheim{number}"))[1]
        assert (await come_in(there.url, None, "plc", "geheim"))[1] == "BadUserAccessDenied"
        now = 61.0
        client, error = await come_in(there.url, None, "plc", "geheim")
        assert error == ""
        await client.disconnect()
        for number in range(2000):  # addresses, of which a bounded number is kept
            with pytest.raises(KeyError), logins.counting_attempt(str(number)):
                raise KeyError
        assert len(logins._failed) == 1000
        for _ in range(9):
            with pytest.raises(KeyError), logins.counting_attempt("1999"):
                raise KeyError
        with logins.counting_attempt("1998"):
            pass
        with pytest.raises(ServiceError), logins.counting_attempt("1999"):
            pass


@pytest.mark.parametrize(
    ("content", "more", "why"),
    [
        (None, {}, "No such file"),
        (b"no certificate", {}, "user_certificates.plc"),
        (b"", {"other": "user.pem"}, "two users have the same certificate"),
    ],
)
async def test_a_users_certificate_that_is_of_no_use_is_told(
    tmp_path: Path, content: bytes | None, more: dict[str, str], why: str
) -> None:
    if content is not None:
        (tmp_path / "plc.der").write_bytes(content)
    if more:
        made = user_files(tmp_path / "made", "plc")
        (made / "user.der").rename(tmp_path / "plc.der")
        (made / "user.pem").rename(tmp_path / "user.pem")
    listen = f"opc.tcp://127.0.0.1:{free_port()}"
    settings = {"listen": listen, "user_certificates": {"plc": "plc.der", **more}}
    async with Outlets({"opcua": settings}, tmp_path) as outlets:
        await until(lambda: bool(outlets.states["opcua"].trouble))
        assert why in outlets.states["opcua"].trouble


@pytest.mark.long
async def test_a_client_with_a_certificate_that_is_not_trusted_is_refused(
    tmp_path: Path, identity: Path
) -> None:
    (tmp_path / "trusted").mkdir()
    key = generate_private_key()
    names: list[Any] = [x509.UniformResourceIdentifier("urn:other")]
    other = generate_self_signed_app_certificate(
        key, "other", {}, names, [ExtendedKeyUsageOID.CLIENT_AUTH]
    )
    (tmp_path / "trusted" / "other.der").write_bytes(other.public_bytes(Encoding.DER))
    async with cell(tmp_path, unencrypted=False, clients="trusted") as there:
        assert (await come_in(there.url, identity))[1]


@pytest.mark.long
async def test_anonymous_clients_that_may_read_call_nothing_and_write_nothing(
    tmp_path: Path,
) -> None:
    async with cell(tmp_path, anonymous="read") as there, plc(there.url) as client:
        await client.wait_for("Ready")
        heard = await client.hear(1024)
        with pytest.raises(ua.UaStatusCodeError):
            await client.start_job()
        with pytest.raises(ua.UaStatusCodeError):
            await client.node("Plain.Count").write_value(7, ua.VariantType.UInt32)
        await there.camera.trigger(timeout=20)
        await until(lambda: bool(heard.of(1024)))
        assert heard.of(1024)[0].JobId.Id == ""


FLEET = """
cameras:
  line1/cam1:
    {emulated: {}, application: bolts, application_names: {bolts: 7}, interpret_as: localizations}
  line1/cam2: {emulated: {}, application: 1}
outlets:
  opcua: {listen: 'URL', anonymous: control, unencrypted: true}
"""


@pytest.mark.long
async def test_two_cameras_of_a_fleet_in_one_server_are_driven_apart(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    url = f"opc.tcp://127.0.0.1:{free_port()}"
    path = tmp_path / "fleet.yaml"
    path.write_text(f"listen: tcp/127.0.0.1:{free_port()}\n" + FLEET.replace("URL", url))
    server = FleetServer(path)
    async with FleetOutlets(server), server, plc(url) as first:
        second = Plc(first.client, "line1/cam2")
        await second.learn()
        for one in (first, second):
            await one.wait_for("Ready")
        heard, other = await first.hear(1024), await second.hear(1024)
        named = {first: "bolts", second: "1"}  # the first by the fleet file's name
        jobs = [await one.start_job(one.camera, "", recipe) for one, recipe in named.items()]
        await until(lambda: bool(heard.of(1024) and other.of(1024)))
    told = [heard.of(1024), other.of(1024)]
    assert [[one.JobId.Id for one in some] for some in told] == [[jobs[0]], [jobs[1]]]
    assert [some[0].MeasId.Id for some in told] == ["line1/cam1", "line1/cam2"]
    assert [some[0].ResultState for some in told] == [1, 1]
    assert [some[0].ExternalRecipeId.Id for some in told] == ["bolts", "1"]


def test_a_wrong_server_in_a_fleet_file_is_told_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    text = FLEET.replace("URL", "opc.tcp://127.0.0.1:4840")
    path.write_text(text.replace("control", "everybody"))
    with pytest.raises(ConfigurationError, match=r"line 7.*outlets\.opcua\.anonymous"):
        load_fleet(path)
