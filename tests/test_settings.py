"""Camera addresses and the options of a connection."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

import smartcam
from smartcam._settings_model import SettingsModel
from smartcam.exceptions import ConfigurationError
from smartcam.registry import PROTOCOLS
from smartcam.settings import (
    _UNUSUAL,
    Address,
    CameraOptions,
    CameraSettings,
    _accept_usual,
    parse_address,
    validation_text,
)

CAMERA_SETTINGS = [one.name for one in dataclasses.fields(CameraSettings)][:-1]
"""All but the names of those that were given."""

NUMBERS: list[Any] = [
    *(None, True, False, -1, 0, 1, 2, 15, 16, 99, 100, 101, 86_400, 86_401, 1 << 30, (1 << 30) + 1),
    *(0xFFFFFFFF, 1 << 32, 10**5000, 0.0, -0.0, 5e-324, 2.2e-308, 0.5, 86_400.0, 86_400.1, -1.0),
    *(float("nan"), float("inf"), "1", b"1", np.int64(1), np.float64(1.0), np.bool_(True)),
]
OPTION_VALUES: dict[str, list[Any]] = {
    **dict.fromkeys(
        [one for one in CAMERA_SETTINGS if type(getattr(CameraSettings, one, None)) in {int, float}]
        + ["application", "y_down", "lenient", "restore"],
        NUMBERS,
    ),
    "name": ["", "left", "n" * 200, "n" * 201, "\0", "\ud800", "é", 1, None, np.str_("a")],
    "reconnect": [None, smartcam.Backoff(), 1],
    "interpret_as": [None, 1],
    "calibration": [None, 1],
}

ACME = """
import dataclasses

from smartcam.exceptions import ConfigurationError
from smartcam.protocols._base import Protocol, Transport
from smartcam.protocols._bvs import B16, HANDBOOK
from smartcam.protocols._framed.dialect import FramedDialect
from smartcam.protocols._framed.machine import Machine

PROTOCOL = Protocol(
    name="acme",
    schemes={"acme": Transport.TCP},
    default_port=4242,
    models=("ACME1",),
    dialects={"handbook": HANDBOOK},
    machine=Machine,
)
SOMETHING = object()


class Guarded(FramedDialect):
    def with_parameters(self, parameters):
        if not parameters.get("slot", "0").isdigit():
            raise ConfigurationError(f"slot {parameters['slot']!r} is no number")
        return self


LOGIN = Protocol(
    name="acme",
    schemes={"acme": Transport.TCP},
    default_port=4242,
    models=("ACME1",),
    dialects={
        "locked": Guarded(
            name="locked",
            header=B16.header,
            word="H",
            table=B16.table,
            about="with a login",
            source="made for the tests",
        )
    },
    machine=Machine,
    parameters={"user": "who", "password": "what only he knows", "slot": "which tray"},
)
"""


@pytest.fixture
def provide(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str, str], None]]:
    """Return a function that puts a distribution with one protocol on the path."""

    def add(name: str, target: str) -> None:
        info = tmp_path / f"{name}_{target.partition(':')[0]}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: maker-of-{name}\nVersion: 1.0\n", encoding="utf-8"
        )
        (info / "entry_points.txt").write_text(
            f"[smartcam.protocols]\n{name} = {target}\n", encoding="utf-8"
        )
        (tmp_path / "acme_camera.py").write_text(ACME, encoding="utf-8")
        PROTOCOLS.refresh()

    monkeypatch.syspath_prepend(tmp_path)
    yield add
    monkeypatch.undo()
    PROTOCOLS.refresh()


# ---------------------------------------------------------------------- addresses


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("bvs://192.168.0.10", Address("bvs", "bvs", "192.168.0.10", 36701)),
        ("bvs://192.168.0.10:4000", Address("bvs", "bvs", "192.168.0.10", 4000)),
        ("bvs+udp://camera", Address("bvs", "bvs+udp", "camera", 36701)),
        ("  BVS://Camera.local/ ", Address("bvs", "bvs", "camera.local", 36701)),
        ("bvs://h:?dialect=thesis", Address("bvs", "bvs", "h", 36701, "thesis")),
        ("bvs://h:65535/?dialect=handbook", Address("bvs", "bvs", "h", 65535, "handbook")),
        ("bvs://[::1]", Address("bvs", "bvs", "::1", 36701)),
        ("bvs://[fe80::1]:7?dialect=thesis", Address("bvs", "bvs", "fe80::1", 7, "thesis")),
        ("bvs://h?dialect=b16", Address("bvs", "bvs", "h", 36701, "b16")),
        ("bvs+udp://h?dialect=bid", Address("bvs", "bvs+udp", "h", 36701, "bid")),
        ("bvs://h?dialect=b16&quirks=code", Address("bvs", "bvs", "h", 36701, "b16", ("code",))),
        (
            "bvs://h?quirks=no_id,%20code,,code&dialect=b16",
            Address("bvs", "bvs", "h", 36701, "b16", ("code", "no_id")),
        ),
        ("bvs://h?dialect=thesis&quirks=", Address("bvs", "bvs", "h", 36701, "thesis")),
        ("bvs://h?quirks", Address("bvs", "bvs", "h", 36701)),
    ],
)
def test_parse_address_good_url_is_read_and_written_back(url: str, address: Address) -> None:
    assert parse_address(url) == address
    assert parse_address(address.url) == address


@pytest.mark.parametrize(
    ("address", "url"),
    [
        (Address("bvs", "bvs", "h", 36701), "bvs://h:36701"),
        (Address("bvs", "bvs+udp", "::1", 7, "thesis"), "bvs+udp://[::1]:7?dialect=thesis"),
        (
            Address("bvs", "bvs", "h", 7, "b16", ("code", "no_id")),
            "bvs://h:7?dialect=b16&quirks=code,no_id",
        ),
    ],
)
def test_address_url_has_everything_that_is_known(address: Address, url: str) -> None:
    assert address.url == url


@pytest.mark.parametrize("model", ["BVS002C", "bvs002c"])
@pytest.mark.parametrize(
    ("host", "address"),
    [
        ("camera", Address("bvs", "bvs", "camera", 36701)),
        ("camera:7", Address("bvs", "bvs", "camera", 7)),
        ("[::1]:7", Address("bvs", "bvs", "::1", 7)),
        ("bvs+udp://camera", Address("bvs", "bvs+udp", "camera", 36701)),
    ],
)
def test_parse_address_bare_host_with_model_is_its_protocols(
    host: str, address: Address, model: str
) -> None:
    assert parse_address(host, model=model) == address


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("", "'' has no host"),
        (
            "bvs://h?dialekt=handbook",
            "unknown 'dialekt'; known are 'dialect', 'quirks', 'shows_triggers'; did",
        ),
        ("bsv://h", "did you mean 'bvs'?"),
        ("bvs://h?dialect=hand", "thesis, b16, bid; did you mean 'handbook'?"),
        ("bvs://h?dialect=handbook&dialect=thesis", "names two dialect"),
        ("http://h", "unknown scheme 'http'; known are bvs://, bvs+udp://"),
        ("://h", "unknown scheme ''; known are"),
        ("bvs://", "has no host"),
        ("bvs://:36701", "has no host"),
        ("bvs://?dialect=thesis", "has no host"),
        ("bvs://h:0", "port 0 is no camera's port"),
        ("bvs://h:65536", "Port out of range 0-65535"),
        ("bvs://h:-1", "Port could not be cast to integer value"),
        ("bvs://h:port", "Port could not be cast to integer value as 'port'"),
        ("bvs://[::1", "Invalid IPv6 URL"),
        ("bvs://::1", "Port could not be cast"),
        ("bvs://me@h", "has a user, which means nothing"),
        ("bvs://:secret@h", "has a user, which means nothing"),
        ("bvs://h/path", "has a path, which means nothing"),
        ("bvs://h#part", "has a fragment, which means nothing"),
        ("bvs://h?colour=red", "unknown 'colour'; known are 'dialect', 'quirks'"),
        ("bvs://h?user=me", "unknown 'user'; known are 'dialect', 'quirks'"),
        ("bvs://h?dialect=latin", "bvs has no dialect 'latin'; it has handbook, thesis, b16, bid"),
        ("bvs://h?quirks=code", "quirks belong to a dialect: name the dialect, too"),
        ("bvs://h?dialect=b16&quirks=a&quirks=b", "names two quirks"),
        (
            "bvs://h?dialect=b16&quirks=loud",
            "dialect b16 has no quirk 'loud'; it has code, no_id, big_endian_number",
        ),
        ("bvs://h?dialect=bid&quirks=code", "dialect bid has no quirk 'code'; it has none"),
        ("bvs://h?dialect", "bvs has no dialect ''"),
    ],
)
def test_parse_address_bad_url_says_what_is_wrong(url: str, text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_address(url)
    shown = url.replace("secret", "***")
    assert str(caught.value).startswith(f"camera address {shown!r}")
    assert text in str(caught.value)


def test_parse_address_unknown_model_names_the_known_ones() -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_address("camera", model="BVS1")
    assert str(caught.value).startswith("unknown camera model 'BVS1'; known are BVS002C")


# ---------------------------------------------------------------------- plug-ins


def test_parse_address_scheme_of_a_plugin_is_known(provide: Callable[[str, str], None]) -> None:
    provide("acme", "acme_camera:PROTOCOL")
    assert parse_address("acme://h") == Address("acme", "acme", "h", 4242)
    assert parse_address("h:5", model="acme1") == Address("acme", "acme", "h", 5)
    with pytest.raises(ConfigurationError, match="known are acme://, bvs://"):
        parse_address("http://h")


@pytest.mark.parametrize(
    "target", ["acme_nowhere:PROTOCOL", "acme_camera:MISSING", "acme_camera:SOMETHING"]
)
def test_parse_address_broken_plugin_costs_only_its_own_name(
    provide: Callable[[str, str], None], target: str
) -> None:
    provide("acme", target)
    assert parse_address("bvs://h").protocol == "bvs"
    assert parse_address("h", model="BVS002C").protocol == "bvs"
    with pytest.raises(ConfigurationError, match=r"unknown scheme 'acme'; known are bvs://"):
        parse_address("acme://h")


def test_parse_address_plugin_with_our_own_name_is_left_out(
    provide: Callable[[str, str], None],
) -> None:
    known = parse_address("bvs://h")
    provide("bvs", "acme_camera:PROTOCOL")
    assert parse_address("bvs://h") == known


def test_parse_address_of_our_own_scheme_looks_at_nothing_that_is_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def looked() -> Iterator[None]:
        raise AssertionError("looked")

    PROTOCOLS.refresh()
    monkeypatch.setattr("importlib.metadata.distributions", looked)
    assert parse_address("bvs+udp://h").protocol == "bvs"
    assert parse_address("h").protocol == "bvs"
    monkeypatch.undo()


def test_parse_address_again_goes_by_the_protocols_of_now(
    provide: Callable[[str, str], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    provide("acme", "acme_camera:PROTOCOL")
    assert parse_address("acme://h") == parse_address("acme://h")
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one != str(tmp_path)])
    PROTOCOLS.refresh()
    with pytest.raises(ConfigurationError, match=r"unknown scheme 'acme'"):
        parse_address("acme://h")


# ---------------------------------------------------------------------- a login


@pytest.fixture
def login(provide: Callable[[str, str], None]) -> None:
    """A protocol whose cameras have users, passwords and one more parameter."""
    provide("acme", "acme_camera:LOGIN")


@pytest.mark.usefixtures("login")
@pytest.mark.parametrize(
    ("url", "parameters", "shown"),
    [
        ("acme://h", {}, "acme://h:4242"),
        ("acme://h?slot=3", {"slot": "3"}, "acme://h:4242?slot=3"),
        ("acme://me@h", {"user": "me", "password": ""}, "acme://me@h:4242"),
        ("acme://me:secret@h", {"user": "me", "password": "secret"}, "acme://me@h:4242"),
        (
            "acme://m%40e%2F:se%3Acr%40et@h:7?slot=3&dialect=locked",
            {"slot": "3", "user": "m@e/", "password": "se:cr@et"},
            "acme://m%40e%2F@h:7?dialect=locked&slot=3",
        ),
    ],
)
def test_parse_address_parameters_are_kept_and_the_url_has_no_password(
    url: str, parameters: dict[str, str], shown: str
) -> None:
    address = parse_address(url)
    assert dict(address.parameters) == parameters
    assert address.url == shown
    again = parse_address(shown)
    without = {key: value for key, value in parameters.items() if key != "password"}
    assert {k: v for k, v in again.parameters if k != "password"} == without
    assert again.url == shown


@pytest.mark.usefixtures("login")
@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("acme://me:secret@h?slot=x", "'acme://me:***@h?slot=x': slot 'x' is no number"),
        ("acme://me:secret@h?slot=1&slot=2", "'acme://me:***@h?slot=1&slot=2' names two slot"),
        (
            "acme://me:secret@h?colour=red",
            "'acme://me:***@h?colour=red': unknown 'colour'; known are 'dialect', 'quirks', 'slot'",
        ),
        (
            "acme://me:secret@h?dialect=latin",
            "'acme://me:***@h?dialect=latin': acme has no dialect 'latin'; it has locked",
        ),
        (
            "acme://me:secret@h?dialect=locked&quirks=loud",
            "'acme://me:***@h?dialect=locked&quirks=loud': "
            "dialect locked has no quirk 'loud'; it has none",
        ),
        ("acme://me:secret@h/tray", "'acme://me:***@h/tray' has a path, which means nothing"),
        ("acme://me:secret@", "'acme://me:***@' has no host"),
        ("acme://me:secret@h:0", "'acme://me:***@h:0': port 0 is no camera's port"),
        ("acme://me:secret@h:70000", "'acme://me:***@h:70000': Port out of range 0-65535"),
        ("acme://me:se[cret@h", "'acme://me:***@h'"),
        ("bvs://me:secret@h", "'bvs://me:***@h' has a user, which means nothing"),
        ("other://me:secret@h", "'other://me:***@h': unknown scheme 'other'"),
        ("me:secret@h", "'me:***@h' has a user, which means nothing"),
        ("acme://h?user=me&password=secret", "unknown 'user'"),
    ],
)
def test_parse_address_error_never_shows_a_password(url: str, text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_address(url)
    assert text in str(caught.value)
    assert "cret" not in str(caught.value)


@pytest.mark.usefixtures("login")
def test_settings_show_no_password() -> None:
    settings = CameraSettings.make("acme://me:secret@h", None, {})
    assert settings.name == "h:4242"
    assert "secret" not in repr(settings)


# ---------------------------------------------------------------------- options


def make(**options: Any) -> CameraSettings:
    return CameraSettings.make("bvs://h", None, options)


def test_settings_defaults_are_the_documented_ones() -> None:
    settings = make()
    assert settings.address == Address("bvs", "bvs", "h", 36701)
    assert settings.name == "h:36701"
    assert (settings.application, settings.interpret_as) == (None, None)
    assert (settings.y_down, settings.lenient) == (False, False)
    assert (settings.connect_timeout, settings.switch_timeout) == (10.0, 10.0)
    assert (settings.request_timeout, settings.close_timeout) == (5.0, 1.0)
    assert (settings.connect_attempts, settings.max_length) == (3, 1 << 20)


def test_settings_options_are_taken_as_given() -> None:
    spec = {7: "localizations"}
    settings = make(
        name="cell 1", application=0, interpret_as=spec, y_down=True, connect_timeout=0.5
    )
    assert (settings.name, settings.application) == ("cell 1", 0)
    assert settings.interpret_as is spec
    assert (settings.y_down, settings.connect_timeout) == (True, 0.5)


def test_settings_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        make().name = "other"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("option", "value", "text"),
    [
        ("application", -1, "greater than or equal to 0 (got -1)"),
        ("application", 1 << 32, "less than or equal to 4294967295"),
        ("application", "seven", "valid integer"),
        ("connect_timeout", 0, "greater than 0 (got 0)"),
        ("connect_timeout", float("nan"), "(got nan)"),
        ("switch_timeout", float("inf"), "(got inf)"),
        ("request_timeout", -1.0, "greater than 0"),
        ("close_timeout", 86_401, "less than or equal to 86400"),
        ("connect_attempts", 0, "greater than or equal to 1"),
        ("connect_attempts", 101, "less than or equal to 100"),
        ("max_length", 15, "greater than or equal to 16"),
        ("max_length", (1 << 30) + 1, "less than or equal to 1073741824"),
        ("name", "n" * 201, "at most 200 characters"),
        ("y_down", "down", "valid boolean"),
        (
            "colour",
            "red",
            "Extra inputs are not permitted; known are application, application_names, calibration",
        ),
    ],
)
def test_settings_wrong_option_is_named_with_what_came(
    option: str, value: object, text: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        make(**{option: value})
    assert str(caught.value).startswith(f"connect: {option}: ")
    assert text in str(caught.value)
    assert isinstance(caught.value.__cause__, ValidationError)


def test_settings_several_wrong_options_are_all_named() -> None:
    with pytest.raises(ConfigurationError) as caught:
        make(application=-1, connect_attempts=0)
    assert str(caught.value).count("; ") == 1
    assert "application: " in str(caught.value)
    assert "connect_attempts: " in str(caught.value)


def test_settings_address_is_no_option() -> None:
    with pytest.raises(ConfigurationError, match=r"^connect: address: Extra inputs"):
        make(address="bvs://other")


def test_settings_bad_address_comes_first() -> None:
    with pytest.raises(ConfigurationError, match="unknown scheme"):
        CameraSettings.make("http://h", None, {"application": -1})


def test_settings_model_picks_the_protocol_of_a_bare_host() -> None:
    assert CameraSettings.make("h", "BVS002C", {}).address.url == "bvs://h:36701"


def test_validation_text_cuts_long_input_and_names_the_whole_value() -> None:
    class Inner(BaseModel):
        number: int

    class Outer(BaseModel):
        inner: list[Inner]

    with pytest.raises(ValidationError) as caught:
        Outer.model_validate({"inner": [{"number": "x" * 500}]})
    text = validation_text(caught.value)
    assert text.startswith("inner.0.number: ")
    assert text.endswith(f"(got '{'x' * 79})")
    with pytest.raises(ValidationError) as caught:
        Outer.model_validate(3)
    assert validation_text(caught.value).startswith("value: ")


@pytest.mark.parametrize("option", ["connect_attempts", "connect_timeout", "application"])
def test_number_with_more_digits_than_can_be_written_is_refused(option: str) -> None:
    with pytest.raises(ConfigurationError, match=f"{option}: .*too long to be shown"):
        CameraSettings.make("bvs://127.0.0.1", None, {option: 10**5000})


def test_options_are_those_of_the_settings() -> None:
    assert ["address", *SettingsModel.model_fields] == CAMERA_SETTINGS
    assert {*CameraOptions.__annotations__} == {*SettingsModel.model_fields}


@pytest.mark.parametrize("option", [*OPTION_VALUES])
def test_options_that_are_taken_at_once_are_those_that_the_model_takes(option: str) -> None:
    for value in OPTION_VALUES[option]:
        taken = _accept_usual(option, value)
        if taken is _UNUSUAL:
            continue
        judged = getattr(SettingsModel(**{option: value}), option)
        assert (judged, type(judged)) == (taken, type(taken)), value
    assert any(_accept_usual(option, value) is not _UNUSUAL for value in OPTION_VALUES[option])


def test_usual_options_need_no_pydantic() -> None:
    code = (
        "import sys, smartcam\n"
        "smartcam.connect('bvs://h', application=7, interpret_as='localizations', name='left',\n"
        "    y_down=True, connect_timeout=2, liveness_timeout=None, reconnect=None)\n"
        "print('pydantic' in sys.modules, 'importlib.metadata' in sys.modules)"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout == "False False\n"


@pytest.mark.parametrize(
    ("option", "meant"),
    [("aplication", "application"), ("interpret", "interpret_as"), ("y_Down", "y_down")],
)
def test_option_that_is_misspelt_says_which_is_meant(option: str, meant: str) -> None:
    options: dict[str, Any] = {option: 7}
    with pytest.raises(ConfigurationError, match=f"{option}: .*; did you mean '{meant}'"):
        smartcam.connect("camera", **options)


def test_bare_host_speaks_bvs_over_tcp() -> None:
    assert smartcam.connect("camera").url == "bvs://camera:36701"


def test_name_is_the_place_where_none_is_given_however_long_that_is() -> None:
    host = "h" * 230
    assert CameraSettings.make(f"bvs://{host}", None, {}).name == f"{host}:36701"
    assert CameraSettings.make("bvs://h", None, {}).name == "h:36701"
    assert CameraSettings.make("bvs://h", None, {"name": ""}).name == "h:36701"
    assert CameraSettings.make("bvs://h", None, {"name": "left"}).name == "left"
