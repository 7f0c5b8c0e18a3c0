"""Fleet files: valid contents, and errors for mistakes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

import smartcam.fleet
from smartcam.exceptions import ConfigurationError
from smartcam.fleet import FleetFile, load_fleet
from smartcam.fleet._inside import fleet_schema
from tests import ROOT
from tests.schemas import plain

EXAMPLE = """\
fleet: plant
listen: tcp/127.0.0.1:7447        # this agent is the router, too; or connect: [tls/plant-server:7447]
cameras:
  line1/cam3: {url: "bvs://192.168.0.10", application: 7, interpret_as: localizations, restore: true}
  line1/cam4: {url: "insight://admin@192.168.0.11"}
  line2/**: {emulated: {count: 20}}   # emulated ones, to try a plant on a desk
"""  # noqa: E501 - as people write it


def write(folder: Path, text: str) -> Path:
    path = folder / "fleet.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def load(folder: Path, text: str) -> FleetFile:
    return load_fleet(write(folder, text))


def names(file: FleetFile) -> list[str]:
    return [planned.name for planned in file.plan()]


# ---------------------------------------------------------------------- what it says


def test_example_loads_as_written(tmp_path: Path) -> None:
    file = load_fleet(str(write(tmp_path, EXAMPLE)))
    twenty = [f"line2/cam{n:02}" for n in range(1, 21)]
    assert names(file) == ["line1/cam3", "line1/cam4", *twenty]
    assert file.endpoints == (("tcp/127.0.0.1:7447",), ())
    cam3 = file.cameras["line1/cam3"]
    settings = cam3.settings("line1/cam3", cam3.url or "")
    assert (settings.application, settings.interpret_as) == (7, "localizations")
    assert (settings.restore, settings.name, settings.address.port) == (True, "line1/cam3", 36701)
    cam4 = file.cameras["line1/cam4"]
    assert cam4.settings("line1/cam4", cam4.url or "").address.parameters[0] == ("user", "admin")


def test_defaults(tmp_path: Path) -> None:
    file = load(tmp_path, "cameras:\n  cam1: {emulated: {}}\n")
    assert file.fleet == "plant"
    assert file.endpoints == (("tcp/127.0.0.1:7447",), ())
    assert re.fullmatch(r"[a-z0-9_-]+-\d+", file.agent_name)
    settings = file.cameras["cam1"].settings("cam1", "bvs://127.0.0.1")
    assert settings.reconnect is not None
    assert settings.reconnect.attempts is None


@pytest.mark.parametrize(
    ("count", "first", "last"), [(1, "a/cam1", "a/cam1"), (200, "a/cam001", "a/cam200")]
)
def test_emulated_cameras_of_a_pattern_are_numbered(
    tmp_path: Path, count: int, first: str, last: str
) -> None:
    found = names(load(tmp_path, f"cameras:\n  a/**: {{emulated: {{count: {count}}}}}\n"))
    assert (found[0], found[-1], len(set(found))) == (first, last, count)


@pytest.mark.parametrize("said", ["false", "null"])
def test_lost_camera_may_be_left_alone(tmp_path: Path, said: str) -> None:
    text = f"cameras:\n  a: {{url: 'bvs://h', reconnect: {said}}}\n"
    assert load(tmp_path, text).cameras["a"].settings("a", "bvs://h").reconnect is None


def test_reconnect_is_taken_over(tmp_path: Path) -> None:
    text = "cameras:\n  a: {url: 'bvs://h', reconnect: {initial: 1, attempts: 3}}\n"
    reconnect = load(tmp_path, text).cameras["a"].settings("a", "bvs://h").reconnect
    assert reconnect is not None
    assert (reconnect.initial, reconnect.maximum, reconnect.attempts) == (1.0, 10.0, 3)


def test_layouts_may_be_of_applications(tmp_path: Path) -> None:
    text = "cameras:\n  a: {url: 'bvs://h', interpret_as: {7: localizations, 3: 'n: int32'}}\n"
    assert load(tmp_path, text).cameras["a"].interpret_as == {7: "localizations", 3: "n: int32"}


CAMERAS = "cameras: {a: {emulated: {}}}\n"


@pytest.mark.parametrize(
    ("text", "listen", "connect"),
    [
        ("listen: tcp/0.0.0.0:7447\naccess: anyone-may-command", ("tcp/0.0.0.0:7447",), ()),
        ("listen: ['tcp/[::1]:0', tcp/localhost:1]", ("tcp/[::1]:0", "tcp/localhost:1"), ()),
        ("connect: tcp/plant-server.example:7447", (), ("tcp/plant-server.example:7447",)),
        ("listen: []", ("tcp/127.0.0.1:7447",), ()),
    ],
)
def test_endpoints(tmp_path: Path, text: str, listen: Any, connect: Any) -> None:
    assert load(tmp_path, f"{text}\n{CAMERAS}").endpoints == (listen, connect)


def test_certificates_stand_beside_the_file(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    text = f"listen: tls/plant-server:7447\ncertificates: keys\n{CAMERAS}"
    folder.mkdir()
    (folder / "ca.pem").touch()
    with pytest.raises(ConfigurationError, match=r"line 2: certificates: .*no cert.pem, no key"):
        load(tmp_path, text)
    for name in ("cert.pem", "key.pem"):
        (folder / name).touch()
    assert load(tmp_path, text).certificates == str(folder)


# ---------------------------------------------------------------------- mistakes


def camera(said: str) -> str:
    return f"cameras:\n  line1/cam3:\n    {said}\n"


URL = "url: bvs://192.168.0.10\n    "


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": expected fields such as 'cameras:'"),
        ("# nothing\n", ": expected fields such as 'cameras:'"),
        ("- 1\n", ": expected fields such as"),
        (
            "connect: tcp/h:1\ncameras: {}\n",
            ", line 2: cameras: an agent without cameras is only a router",
        ),
        ("fleet: plant\n", ", line 1: cameras: Field required"),
        (f"flet: plant\n{CAMERAS}", ", line 1: flet: Extra inputs .*; did you mean 'fleet'"),
        (camera(f"{URL}aplication: 7"), ", line 4: cameras.line1/cam3.aplication: .*'application'"),
        (
            camera(f"{URL}reconnect: {{initail: 1}}"),
            ", line 4: cameras.line1/cam3.reconnect.initail: .*; did you mean 'initial'",
        ),
        (
            camera("emulated: {cuont: 2}"),
            ", line 3: cameras.line1/cam3.emulated.cuont: .*; did you mean 'count'",
        ),
        (f"fleet: Plant A\n{CAMERAS}", ", line 1: fleet: name 'Plant A': expected a-z"),
        (f"agent: a/b\n{CAMERAS}", ", line 1: agent: name 'a/b': expected a-z"),
        ("cameras:\n  Line1/cam3: {emulated: {}}\n", ", line 2: cameras.Line1/cam3: .*such as li"),
        ("cameras:\n  a/b/c/d/e: {emulated: {}}\n", ", line 2: cameras.a/b/c/d/e: .*one to 4 p"),
        ("cameras:\n  a/b/c/d/**: {emulated: {}}\n", ", line 2: .*'a/b/c/d/cam1': .*one to 4 p"),
        (f"cameras:\n  {'a' * 101}: {{emulated: {{}}}}\n", ", line 2: .*100 characters at most"),
        ("cameras:\n  12: {emulated: {}}\n", ", line 2: cameras: the name 12 is no text"),
        ("cameras:\n  no: {emulated: {}}\n", ", line 2: cameras: the name False is no text"),
        ("cameras:\n  line1/*: {emulated: {}}\n", ", line 2: cameras.line1/.*: .*ends in /"),
        ("cameras:\n  '**': {emulated: {}}\n", ", line 2: cameras.*: .*ends in /"),
        ("cameras:\n  a/**: {url: 'bvs://h'}\n", ", line 2: cameras.a/.*: only emulated"),
        (
            camera("emulated: {count: 3}"),
            r", line 3: .*an entry for 3 cameras needs a name such as .*cam3/\*\*",
        ),
        ("cameras:\n  a: {emulated: {}}\n  a: {emulated: {}}\n", ", line 3: 'a' stands there twi"),
        (
            "cameras:\n  a/cam1: {emulated: {}}\n  a/**: {emulated: {}}\n",
            ", line 3: cameras.a/.*: there is a camera a/cam1 already",
        ),
        (
            "cameras:\n  a: {url: 'bvs://h'}\n  b: {url: 'bvs+udp://h:36701'}\n",
            ", line 3: cameras.b.url: a has this address already, and a camera takes one client",
        ),
        (
            camera("application: 7"),
            ", line 3: cameras.line1/cam3: .*url, emulated, software; got none of them",
        ),
        (
            camera(f"{URL}emulated: {{}}"),
            ", line 3: .*cam3: .*url, emulated, software; got url and emulated",
        ),
        (camera("url: bvz://h"), ", line 3: .*cam3.url: .*unknown scheme 'bvz'.*did you mean"),
        (camera("url: fleet://h/a"), ", line 3: .*cam3.url: .*of a fleet"),
        (camera("url: h\n    model: XYZ"), ", line 3: .*cam3.url: unknown camera model 'XYZ'"),
        (camera("emulated: {}\n    model: BVS002C"), ", line 4: .*cam3.model: is for a url"),
        (camera(f"{URL}interpret_as: 'n: int3'"), ", line 4: .*interpret_as: layout: .*int3"),
        (
            camera(f"{URL}interpret_as:\n      7: raw\n      3: 'n: int3'"),
            ", line 6: cameras.line1/cam3.interpret_as.3: layout: ",
        ),
        (camera(f"{URL}interpret_as: localisations"), ", line 4: .*interpret_as: .*localizations"),
        (camera(f"{URL}application: -1"), ", line 4: .*application.*greater than or equal to 0"),
        (camera(f"{URL}application: x"), ", line 4: .*application: a name is given"),
        (camera(f"{URL}switch_timeout: 0"), ", line 4: .*switch_timeout: .*greater than 0"),
        (camera(f"{URL}connect_timeout: .inf"), ", line 4: .*connect_timeout: "),
        (camera(f"{URL}reconnect: true"), ", line 4: .*reconnect: Input should be a valid dict"),
        (
            camera(f"{URL}reconnect: {{initial: 9, maximum: 1}}"),
            ", line 4: .*reconnect: Backoff: maximum: expected",
        ),
        (
            camera("emulated: {count: 0}"),
            ", line 3: .*emulated.count: .*greater than or eq",
        ),
        ("cameras:\n  a/**: {emulated: {count: 1000000}}\n", ", line 2: .*count: .*10000"),
        (
            "cameras:\n  a/**: {emulated: {count: 10000}}\n  b: {emulated: {}}\n",
            ", line 3: cameras.b: 10001 cameras up to here, expected 10000 at most",
        ),
        (
            camera("emulated: {scenario: none.yaml}"),
            ", line 3: .*emulated.scenario: scenario .*none.yaml: .*No such file",
        ),
        (f"history: {{results: 0}}\n{CAMERAS}", ", line 1: history.results: .*greater than or eq"),
        (f"listen: 7447\n{CAMERAS}", ", line 1: listen: expected tcp/HOST:PORT .*got 7447"),
        (f"listen: udp/h:7447\n{CAMERAS}", ", line 1: listen: expected tcp/HOST.*got 'udp/h"),
        (f"listen: tcp/h\n{CAMERAS}", ", line 1: listen: expected tcp/HOST:PORT"),
        (f"listen: tcp/h:65536\n{CAMERAS}", ", line 1: listen: expected tcp/HOST:PORT"),
        (f"listen: tcp/::1:7447\n{CAMERAS}", ", line 1: listen: expected tcp/HOST:PORT"),
        (f"connect: [tcp/h:7447, 7]\n{CAMERAS}", ", line 1: connect: .*got 7"),
        (f"connect: tcp/h:0\n{CAMERAS}", ", line 1: connect: expected tcp/HOST:PORT"),
        (
            f"{CAMERAS}listen: tls/h:7447\n",
            ", line 2: listen: tls/h:7447 needs the key certificates",
        ),
        (
            f"{CAMERAS}connect: tls/h:7447\n",
            ", line 2: connect: tls/h:7447 needs the key certificates",
        ),
        (f"certificates: none\n{CAMERAS}", ", line 1: certificates: .*none has no ca.pem, no cert"),
        ("cameras: [\n", ", line "),
        ("cameras: &a {x: *a}\n", ", line 1: an alias of a value that contains this alias"),
        ("cameras: !!python/object:os.system x\n", ", line 1: could not determine"),
    ],
)
def test_mistake_is_named_with_file_line_and_field(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"(?s)fleet \S*fleet.yaml{message}"):
        load(tmp_path, text)


def test_aliases_that_stand_for_millions_are_refused(tmp_path: Path) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 9)]
    with pytest.raises(ConfigurationError, match=r"fleet.yaml, line \d+: expected 500000 values"):
        load(tmp_path, "\n".join(lines))


def test_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"fleet \S*none.yaml: .*No such file"):
        load_fleet(tmp_path / "none.yaml")
    with pytest.raises(ConfigurationError, match=r"fleet .*: .*directory"):
        load_fleet(tmp_path)


def test_file_in_another_encoding(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_bytes("fleet: präge\n".encode("latin-1"))
    with pytest.raises(ConfigurationError, match=r"fleet \S*fleet.yaml: .*utf-8"):
        load_fleet(path)


@pytest.mark.parametrize("said", ["emulated: {}", "model: X", "application: -1", "reconnect: 5"])
def test_password_is_shown_by_no_error(tmp_path: Path, said: str) -> None:
    text = camera(f"url: insight://admin:s3cret@192.168.0.11:0\n    {said}")
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path, text)
    assert "s3cret" not in f"{caught.value} {caught.value.__cause__}"


def test_password_is_shown_by_no_representation(tmp_path: Path) -> None:
    file = load(tmp_path, camera("url: insight://admin:s3cret@192.168.0.11"))
    assert "s3cret" not in f"{file} {file!r} {file.plan()!r}"
    assert "admin:***@" in repr(file)
    (planned,) = file.plan()
    settings = planned.entry.settings(planned.name, planned.entry.url or "")
    assert ("password", "s3cret") in settings.address.parameters
    assert "s3cret" not in repr(settings)


def test_mistakes_of_a_file_made_in_python_are_told_at_once() -> None:
    twice: dict[str, Any] = {"a/cam1": {"emulated": {}}, "a/**": {"emulated": {}}}
    with pytest.raises(ConfigurationError, match="there is a camera a/cam1 already"):
        smartcam.fleet.open(FleetFile.model_validate({"cameras": twice}))


# ---------------------------------------------------------------------- cameras of it


async def test_emulated_cameras_are_of_scenario_files_of_any_make(tmp_path: Path) -> None:
    (tmp_path / "line.yaml").write_text(
        "active: 5\nrunning: true\napplications: [{id: 5, layout: 'n: int32', constant: [42]}]\n",
        encoding="utf-8",
    )
    (tmp_path / "cognex.yaml").write_text(
        "protocol: insight\nactive: 7\nrunning: true\n", encoding="utf-8"
    )
    path = write(
        tmp_path,
        "cameras:\n"
        "  bvs: {emulated: {scenario: line.yaml}, interpret_as: 'n: int32'}\n"
        "  cognex/**: {emulated: {scenario: cognex.yaml, count: 2}}\n",
    )
    async with smartcam.fleet.open(path) as fleet:
        assert [one.name for one in fleet] == ["bvs", "cognex/cam1", "cognex/cam2"]
        assert (await fleet["bvs"].trigger()).value.n == 42
        cognex = fleet["cognex/cam2"]
        assert (await cognex.trigger()).application == 7
        assert (await cognex.read_image()).startswith(b"BM")


async def test_emulated_cameras_have_seeds_of_their_own(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "cameras: {a/**: {emulated: {count: 2, seed: 5}, application: 7}}\n",
    )

    async def seen() -> list[bytes]:
        async with smartcam.fleet.open(path) as fleet:
            outcomes = await fleet.trigger()
            return [one.raw for one in outcomes.values() if isinstance(one, smartcam.Result)]

    first = await seen()
    assert len(set(first)) == 2
    assert await seen() == first


# ---------------------------------------------------------------------- the schema


def against(data: Any) -> list[str]:
    """Return what the schema has against a file."""
    jsonschema = pytest.importorskip("jsonschema", reason="needs jsonschema, of the extra dev")
    validator = jsonschema.Draft202012Validator(fleet_schema())
    return [error.json_path for error in validator.iter_errors(data)]


def entry(**said: Any) -> Any:
    return {"cameras": {"a": said}}


@pytest.mark.long
def test_schema_takes_what_is_right_and_refuses_what_is_wrong() -> None:
    assert against(yaml.safe_load(EXAMPLE)) == []
    assert against({**entry(emulated={}), "listen": ["tcp/h:1"], "certificates": "keys"}) == []
    assert against(entry(url="bvs://h", reconnect=False)) == []
    assert against(entry(url="bvs://h", reconnect={"initial": 1})) == []
    wrong: dict[str, list[Any]] = {
        "$": [{}, {"flet": "plant", **entry(emulated={})}],
        "$.fleet": [{"fleet": "Plant A", **entry(emulated={})}],
        "$.listen": [{"listen": one, **entry(emulated={})} for one in ("udp/h:1", 7447, ["tcp/h"])],
        "$.cameras": [{"cameras": {"Line 1": {"emulated": {}}}}],
        "$.cameras.a": [
            entry(),
            entry(url="bvs://h", emulated={}),
            entry(url="bvs://h", aplication=7),
        ],
        "$.cameras.a.application": [entry(url="bvs://h", application=-1)],
        "$.cameras.a.reconnect": [
            entry(url="bvs://h", reconnect=one) for one in (True, {"initail": 1})
        ],
    }
    for place, files in wrong.items():
        for file in files:
            assert against(file) == [place], file


def test_schema_in_the_documents_is_that_of_the_code() -> None:
    text = (ROOT / "docs" / "fleet.schema.json").read_text(encoding="utf-8")
    assert plain(json.loads(text)) == plain(fleet_schema())


def test_applications_may_be_named_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    text = """
cameras:
  line1/cam3:
    url: "pcic://192.168.0.69"
    application: bolts
    application_names: {bolts: 7, nuts: 12}
    interpret_as: {bolts: "x: real32 mm", 12: raw}
"""
    file.write_text(text)
    entry = load_fleet(file).cameras["line1/cam3"]
    settings = entry.settings("line1/cam3", str(entry.url))
    assert settings.application == 7
    assert set(settings.interpret_as) == {7, 12}
    for wrong in (
        text.replace("application: bolts", "application: bolt"),
        text.replace('{bolts: "x', '{bolt: "x'),
        text.replace("    application_names: {bolts: 7, nuts: 12}\n", ""),
    ):
        file.write_text(wrong)
        with pytest.raises(ConfigurationError, match="application"):
            load_fleet(file)
