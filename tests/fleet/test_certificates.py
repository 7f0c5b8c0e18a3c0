"""Files of ``smartcam fleet certificates``, and access from a fleet file."""

from __future__ import annotations

import json
import os
import ssl
import stat
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization

from smartcam._accepting import is_loopback
from smartcam._zenoh import BusLink
from smartcam.exceptions import ConfigurationError
from smartcam.fleet import FleetFile, FleetServer, load_fleet
from smartcam.fleet._inside import (
    MadeCertificate,
    ZenohConnection,
    make_certificates,
    read_identity,
)
from tests.fleet.inside import CERTIFICATE_FILES, MAX_BYTES, tls_context

YEAR = timedelta(days=365)


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def done(made: list[MadeCertificate]) -> dict[str, str]:
    return {one.name: one.done for one in made}


def test_first_time_and_again(tmp_path: Path) -> None:
    folder = tmp_path / "plant"
    wanted = {"agent": ["line1"], "viewer": ["dashboard"], "operator": ["robot"]}
    made = make_certificates(folder, wanted, hosts=["plant-server", "192.168.0.5"])
    assert done(made) == dict.fromkeys(("line1", "dashboard", "robot"), "made")
    for role, (name,) in wanted.items():
        found = read_identity(folder / name)
        assert (found.role, found.name) == (role, name)
        assert str(found) == f"{role} {name}"
        tls_context(folder / name)
    keys = [*folder.rglob("key.pem")]
    assert len(keys) == 4
    if os.name == "posix":
        assert {stat.S_IMODE(one.stat().st_mode) for one in keys} == {0o600}
    before = content(folder)

    made = make_certificates(folder, {"viewer": ["dashboard", "another"]})
    assert done(made) == {
        "another": "made", "dashboard": "kept", "line1": "kept", "robot": "kept"
    }  # fmt: skip
    after = content(folder)
    assert {name: after[name] for name in before} == before
    assert {name.split("/")[0] for name in after.keys() - before.keys()} == {"another"}


def test_what_ends_soon_is_renewed_with_its_key(tmp_path: Path) -> None:
    make_certificates(tmp_path, {"agent": ["line1"]}, hosts=["plant"], lifetime=timedelta(days=90))
    made = make_certificates(tmp_path, {"viewer": ["a"]}, lifetime=timedelta(seconds=0))
    assert done(made) == {"a": "made", "line1": "kept"}
    (tmp_path / "line1" / "how-to-use.txt").write_text("a note of somebody's")
    before = content(tmp_path)
    made = make_certificates(tmp_path, {})
    assert done(made) == {"a": "renewed", "line1": "kept"}
    after = content(tmp_path)
    assert {name for name in before if before[name] != after[name]} == {"a/cert.pem"}
    assert not read_identity(tmp_path / "a").warning


def test_another_host_is_added(tmp_path: Path) -> None:
    make_certificates(tmp_path, {"agent": ["line1"]}, hosts=["plant"])
    made = make_certificates(tmp_path, {"agent": ["line1"]}, hosts=["10.0.0.1"])
    assert done(made) == {"line1": "renewed"}
    names = ssl._ssl._test_decode_cert(str(tmp_path / "line1" / "cert.pem"))["subjectAltName"]  # type: ignore[attr-defined]
    assert {value for _, value in names} >= {"plant", "10.0.0.1", "localhost", "127.0.0.1"}
    assert done(make_certificates(tmp_path, {"agent": ["line1"]})) == {"line1": "kept"}


def test_none_outlives_its_authority(tmp_path: Path) -> None:
    make_certificates(tmp_path, {"viewer": ["a"]}, lifetime=100 * YEAR)
    found = read_identity(tmp_path / "a")
    assert found.expires_at == found.authority_expires_at


@pytest.mark.parametrize(
    ("wanted", "text"),
    [
        ({"viewer": ["line1"]}, "line1 has the role agent already"),
        ({"viewer": ["x"], "operator": ["x"]}, "x is taken: expected another name"),
        ({"viewer": ["authority"]}, "authority is taken"),
        ({"viewer": ["Dash Board"]}, "viewer 'Dash Board': expected a-z"),
        ({"agent": ["line2"]}, "'not a host"),
    ],
)
def test_wrong_names_change_nothing(
    tmp_path: Path, wanted: dict[str, list[str]], text: str
) -> None:
    make_certificates(tmp_path, {"agent": ["line1"]}, hosts=["plant"])
    before = content(tmp_path)
    hosts = ["not a host"] if "not a host" in text else []
    with pytest.raises(ConfigurationError, match=text):
        make_certificates(tmp_path, wanted, hosts=hosts)
    assert content(tmp_path) == before


def test_authority_is_never_overwritten(tmp_path: Path) -> None:
    make_certificates(tmp_path, {"agent": ["line1"]})
    (tmp_path / "authority" / "key.pem").unlink()
    before = content(tmp_path)
    with pytest.raises(ConfigurationError, match=r"key is not in .* and it is not overwritten"):
        make_certificates(tmp_path, {"viewer": ["a"]})
    assert content(tmp_path) == before
    with pytest.raises(ConfigurationError, match="is not overwritten"):
        make_certificates(tmp_path / "line1", {"viewer": ["a"]})
    assert content(tmp_path) == before


def test_of_another_authority(tmp_path: Path) -> None:
    for name in ("here", "there"):
        make_certificates(tmp_path / name, {"viewer": ["a"]})
    (tmp_path / "here" / "a").rename(tmp_path / "old")
    (tmp_path / "there" / "a").rename(tmp_path / "here" / "a")
    with pytest.raises(ConfigurationError, match="is of another authority than"):
        make_certificates(tmp_path / "here", {})


@pytest.mark.parametrize("name", ["ca.pem", "cert.pem", "key.pem"])
@pytest.mark.parametrize("body", [None, b"", b"garbage"])
def test_files_that_are_none(tmp_path: Path, name: str, body: bytes | None) -> None:
    make_certificates(tmp_path, {"viewer": ["a"]})
    (tmp_path / "a" / name).unlink()
    if body is not None:
        (tmp_path / "a" / name).write_bytes(body)
    with pytest.raises(ConfigurationError, match="certificates: "):
        read_identity(tmp_path / "a")


def test_key_of_another(tmp_path: Path) -> None:
    make_certificates(tmp_path, {"viewer": ["a", "b"]})
    (tmp_path / "b" / "key.pem").replace(tmp_path / "a" / "key.pem")
    with pytest.raises(ConfigurationError, match=r"cert.pem and key.pem do not go together"):
        read_identity(tmp_path / "a")


def test_key_with_a_password_asks_nobody(tmp_path: Path) -> None:
    make_certificates(tmp_path, {"viewer": ["a"]})
    path = tmp_path / "a" / "key.pem"
    key = serialization.load_pem_private_key(path.read_bytes(), None)
    path.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
    )
    with pytest.raises(ConfigurationError, match=r"cert.pem and key.pem do not go together"):
        read_identity(tmp_path / "a")


@pytest.mark.real_time
async def test_configuration_of_a_router(tmp_path: Path) -> None:
    """The engine takes it as it is written."""
    (made,) = make_certificates(tmp_path, {"router": ["hub"]})
    text = (tmp_path / "hub" / "router.json5").read_text()
    assert f"zenohd --config {made.folder}" in made.use
    zenoh = ZenohConnection(BusLink()).zenoh
    config = zenoh.Config.from_json5(text)
    assert json.loads(config.get_json("access_control/default_permission")) == "deny"
    assert json.loads(config.get_json("mode")) == "router"


# ---------------------------------------------------------------------- the fleet file

TO_ALL = "accepts every program without a certificate, and each may command"


@pytest.mark.parametrize(
    ("listen", "access", "text"),
    [
        ("tcp/127.0.0.1:0", None, ""),
        ("tcp/localhost:0", None, ""),
        ("tcp/[::1]:0", None, ""),
        ("tcp/0.0.0.0:7447", None, TO_ALL),
        ("tcp/[::]:7447", None, TO_ALL),
        ("tcp/192.168.0.5:7447", None, TO_ALL),
        ("tcp/plant-server:7447", None, TO_ALL),
        ("tcp/0.0.0.0:7447", "anyone-may-command", ""),
        ("tcp/127.0.0.1:0", "roles", "asks for no certificate, so its programs have no role"),
        ("tcp/127.0.0.1:0", "any-certificate", "any-certificate needs listen: tls/"),
        ("tcp/0.0.0.0:0", "any-certificate", TO_ALL),
    ],
)
def test_who_may_use_it(tmp_path: Path, listen: str, access: str | None, text: str) -> None:
    said = {"listen": listen, "cameras": {"a": {"emulated": {}}}}
    if access is not None:
        said["access"] = access
    file = tmp_path / "fleet.yaml"
    file.write_text(json.dumps(said))
    if text:
        with pytest.raises(ConfigurationError, match=text):
            load_fleet(file)
        with pytest.raises(ConfigurationError, match=text) as caught:
            FleetServer(FleetFile.model_validate(said))
        if text is TO_ALL:
            assert "access: anyone-may-command" in str(caught.value)
            assert "smartcam fleet certificates" in str(caught.value)
    else:
        load_fleet(file)
        FleetServer(FleetFile.model_validate(said))


def test_roles_want_tls_alone(tmp_path: Path) -> None:
    make_certificates(tmp_path, {"agent": ["line1"]})
    said = {
        "listen": ["tls/127.0.0.1:0", "tcp/127.0.0.1:0"],
        "certificates": str(tmp_path / "line1"),
        "cameras": {"a": {"emulated": {}}},
    }
    with pytest.raises(ConfigurationError, match=r"tcp/127\.0\.0\.1:0 asks for no certificate"):
        FleetServer(FleetFile.model_validate(said))
    FleetServer(FleetFile.model_validate({**said, "access": "any-certificate"}))


def test_loopback() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.3.2.1", "[::1]", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "[::]", "10.0.0.1", "localhost.plant", "")))  # noqa: S104


def test_certificate_of_more_than_a_megabyte_is_refused(tmp_path: Path) -> None:
    for name in CERTIFICATE_FILES:
        (tmp_path / name).write_bytes(bytes(MAX_BYTES + 1))
    with pytest.raises(ConfigurationError, match=f"expected {MAX_BYTES} bytes at most"):
        read_identity(tmp_path)
