"""Addresses of fleets, names of cameras, and ``connect()`` with them."""

from __future__ import annotations

import sys
from typing import Any

import pytest

import smartcam
import smartcam.fleet
from smartcam._zenoh import load_zenoh
from smartcam.exceptions import ConfigurationError, MissingExtraError, UnsupportedError
from smartcam.fleet._inside import FleetAddress
from smartcam.settings import parse_address
from tests.fleet.inside import check_name, check_pattern
from tests.test_exports import newly_imported

PARSED = [
    ("fleet://plant-server", "fleet://plant-server:7447", "tcp/plant-server:7447"),
    ("fleet://h:1/line1/cam3", "fleet://h:1/line1/cam3", "tcp/h:1"),
    (" FLEET://H/a/ ", "fleet://h:7447/a", "tcp/h:7447"),
    ("fleet://10.0.0.1/a?fleet=p", "fleet://10.0.0.1:7447/a?fleet=p", "tcp/10.0.0.1:7447"),
    ("fleet://[::1]:7448/a/b", "fleet://[::1]:7448/a/b", "tcp/[::1]:7448"),
    (
        "fleet+tls://h/a?certificates=my%20keys",
        "fleet+tls://h:7447/a?certificates=my+keys",
        "tls/h:7447",
    ),
]


@pytest.mark.parametrize(("url", "whole", "endpoint"), PARSED)
def test_address(url: str, whole: str, endpoint: str) -> None:
    address = FleetAddress.parse(url)
    assert address.of(address.camera).url == whole
    assert FleetAddress.parse(whole) == address
    assert address.link.connect == (endpoint,)
    assert address.link.listen == ()


@pytest.mark.parametrize("url", ["fleet:///line1/cam3", "fleet://", "fleet://:7447/line1/cam3"])
def test_missing_host_is_not_guessed(url: str) -> None:
    with pytest.raises(ConfigurationError, match=r"has no host: .*computer it is localhost"):
        smartcam.connect(url)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("h/a", r"'h/a': expected fleet://HOST\[:PORT\]\[/CAMERA\], got scheme ''"),
        ("flet://h/a", "got scheme 'flet'; did you mean 'fleet'"),
        ("fleet://[::1/a", "fleet://.*: "),
        ("fleet://h x/a", "'h x' is no host"),
        ("fleet://h,i/a", "'h,i' is no host"),
        ("fleet://h:0/a", "port 0, which means nothing"),
        ("fleet://h:99999/a", "99999.*: .*0-65535"),
        ("fleet://h:x/a", "h:x.*: .*'x'"),
        ("fleet://admin@h/a", "a user, which means nothing"),
        ("fleet://h/a#b", "a fragment, which means nothing"),
        ("fleet://h/a?fleat=plant", "unknown 'fleat'; .*did you mean 'fleet'"),
        ("fleet://h/a?dialect=bid", "unknown 'dialect'; known are 'fleet', 'certificates'"),
        ("fleet://h/a?fleet=a&fleet=b", "names two fleet"),
        ("fleet://h/a?fleet=", "fleet '': expected a-z"),
        ("fleet://h/a?fleet=Plant", "fleet 'Plant': expected a-z"),
        ("fleet://h/Line1", "camera 'Line1': expected a name such as line1/cam3"),
        ("fleet://h/a//b", "camera 'a//b': expected a name"),
        ("fleet://h/a/b/c/d/e", "one to 4 parts"),
        ("fleet://h/line1/*", r"camera 'line1/\*': expected a name"),
        ("fleet://h/line1%2Fcam3", "camera 'line1%2Fcam3': expected a name"),
        (f"fleet://h/{'a' * 101}", "100 characters at most"),
        ("fleet://h/a?certificates=keys", r"certificates are for fleet\+tls"),
        ("fleet+tls://h/a", r"certificates=DIR, or the variable SMARTCAM_FLEET_CERTIFICATES"),
        ("fleet+tls://h/a?certificates=", r"expected certificates"),
    ],
)
def test_wrong_address_says_which_part(
    url: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SMARTCAM_FLEET_CERTIFICATES", raising=False)
    with pytest.raises(ConfigurationError, match=message):
        FleetAddress.parse(url)


@pytest.mark.parametrize("url", ["fleet://u:s3cret@h/a", "fleet://u:s3c[ret@h/a", "flt://u:s3c@h"])
def test_password_is_not_shown(url: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        FleetAddress.parse(url)
    assert "s3c" not in f"{caught.value} {caught.value.__cause__}"


def test_variable_has_the_certificates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SMARTCAM_FLEET_CERTIFICATES", "/etc/keys")
    assert FleetAddress.parse("fleet+tls://h/a").link.certificates == "/etc/keys"
    assert FleetAddress.parse("fleet+tls://h/a?certificates=mine").certificates == "mine"
    assert FleetAddress.parse("fleet://h/a").certificates is None


def test_names() -> None:
    for name in ("cam3", "line1/cam3", "a/b/c/d", "_-0/x_y"):
        assert check_name(name) == check_pattern(name) == name
    for pattern in ("*", "**", "line1/*", "*/cam3", "line1/**/cam3"):
        assert check_pattern(pattern) == pattern
        with pytest.raises(ConfigurationError, match=r"expected a name"):
            check_name(pattern)
    for wrong in ("", "/", "a/", "/a", "A", "a b", "a.b", "ä", "a\n", "a/$*", "a" * 101):
        with pytest.raises(ConfigurationError, match=r"expected a name"):
            check_name(wrong)
        with pytest.raises(ConfigurationError, match=r"expected a camera's name, with"):
            check_pattern(wrong)
    with pytest.raises(ConfigurationError, match="expected a camera's name, with"):
        check_pattern("line*/cam3")


# ---------------------------------------------------------------------- cameras and fleets


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"aplication": 7}, "aplication: Extra inputs .*; did you mean 'application'"),
        ({"application": -1}, "application: .*greater than or equal to 0"),
        ({"switch_timeout": 0}, "switch_timeout: .*greater than 0"),
        ({"interpret_as": "n: int3"}, "int3"),
        ({"interpret_as": "localisations"}, "localizations"),
        ({"reconnect": 5}, "reconnect: "),
    ],
)
def test_options_are_validated_at_once(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        smartcam.connect("fleet://localhost/line1/cam3", **options)


def test_address_of_the_fleet_is_no_cameras() -> None:
    with pytest.raises(ConfigurationError, match=r"names no camera: .*smartcam.fleet.open"):
        smartcam.connect("fleet://localhost")
    with pytest.raises(ConfigurationError, match=r"is a camera's; smartcam.connect\(\)"):
        smartcam.fleet.open("fleet://localhost/line1/cam3")


def test_where_a_wire_is_wanted_it_says_so() -> None:
    with pytest.raises(UnsupportedError, match="of a fleet"):
        parse_address("fleet://localhost/line1/cam3")


def test_camera_is_called_by_its_name() -> None:
    camera = smartcam.connect("fleet://localhost/line1/cam3")
    assert (camera.name, camera.url) == ("line1/cam3", "fleet://localhost:7447/line1/cam3")
    assert repr(camera) == "<FleetCamera line1/cam3 fleet://localhost:7447/line1/cam3>"
    assert not camera.connected
    assert smartcam.connect("fleet://localhost/line1/cam3", name="cam").name == "cam"


def test_without_zenoh_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    load_zenoh.cache_clear()
    with pytest.raises(MissingExtraError, match=r'pip install "smartcam\[fleet\]"') as caught:
        smartcam.connect("fleet://localhost/line1/cam3")
    assert caught.value.extra == "fleet"
    load_zenoh.cache_clear()


def test_engine_is_imported_for_fleet_urls_only() -> None:
    watched = ["zenoh", "smartcam.fleet._bus.zenoh"]
    wire = "smartcam.connect('bvs://127.0.0.1', interpret_as='localizations')"
    assert newly_imported(f"import smartcam; {wire}", watched) == []
    url = "smartcam.connect('fleet://127.0.0.1/line1/cam3')"
    assert set(newly_imported(f"import smartcam; {url}", watched)) == set(watched)


def test_fleet_in_this_process_needs_no_engine() -> None:
    file = "smartcam.fleet.FleetFile(cameras={'a': {'emulated': {}}})"
    code = f"import smartcam.fleet; smartcam.fleet.open({file})"
    assert newly_imported(code, ["zenoh"]) == []


def test_address_says_what_the_program_is_called() -> None:
    address = FleetAddress.parse("fleet://h/a?program=robot1")
    assert address.program == "robot1"
    assert address.of("a").url == "fleet://h:7447/a?program=robot1"
    with pytest.raises(ConfigurationError, match="program"):
        FleetAddress.parse("fleet://h/a?program=Robot 1")
