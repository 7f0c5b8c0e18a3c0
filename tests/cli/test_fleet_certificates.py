"""``smartcam fleet certificates``, and what other commands say of certificates."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest

from smartcam.fleet._inside import make_certificates
from tests.cli.commandline import run
from tests.fleet.plantkit import CAMERA
from tests.processes import Process

NAMES = ("--agent", "line1", "--viewer", "dashboard", "--operator", "robot")

FLEET = """\
listen: tls/127.0.0.1:0
agent: line1
certificates: keys/line1
cameras: {line1/cam3: {emulated: {}, application: 7}}
"""


def test_certificates_are_reported(tmp_path: Path) -> None:
    folder = str(tmp_path / "keys")
    lines = (
        run("fleet", "certificates", folder, *NAMES, "--host", "plant-server")
        .done()
        .out.splitlines()
    )
    assert [line.split()[:3] for line in lines[1:]] == [
        ["dashboard", "viewer", "made"],
        ["line1", "agent", "made"],
        ["robot", "operator", "made"],
    ]
    how = {name: (tmp_path / "keys" / name / "how-to-use.txt").read_text() for name in (
        "dashboard", "line1", "robot"
    )}  # fmt: skip
    assert f"certificates: {folder}/line1" in how["line1"]
    assert "listen: tls/0.0.0.0:7447" in how["line1"]
    assert "plant-server" in how["line1"]
    assert f"fleet+tls://HOST:7447/CAMERA?certificates={folder}/robot" in how["robot"]
    told = run("fleet", "certificates", folder, "--viewer", "b", "--days", "0.5", "--json").lines
    said = {one["name"]: one for one in told}
    assert {name: one["done"] for name, one in said.items()} == {
        "b": "made", "dashboard": "kept", "line1": "kept", "robot": "kept"
    }  # fmt: skip
    assert said["b"]["role"] == "viewer"


def test_certificates_wrong_use(tmp_path: Path) -> None:
    folder = str(tmp_path)
    run("fleet", "certificates", folder, "--viewer", "a").done()
    run("fleet", "certificates", folder, "--operator", "a").failed(2, "a has the role viewer")
    run("fleet", "certificates", folder, "--viewer", "A b").failed(2, "viewer 'A b': expected a-z")
    assert "is not in the range" in run("fleet", "certificates", folder, "--days", "0").err
    (tmp_path / "other").mkdir()
    out = run("fleet", "certificates", str(tmp_path / "other")).done().out
    assert "and no certificates yet" in out


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """Give the folder of certificates of an agent that runs, and the fleet's URL."""
    folder = tmp_path_factory.mktemp("plant")
    keys = folder / "keys"
    make_certificates(keys, {"agent": ["line1"]}, lifetime=timedelta(days=20.5))
    make_certificates(keys, {"viewer": ["dashboard"], "operator": ["robot"]})
    (folder / "plant.yaml").write_text(FLEET)
    with Process("smartcam", "serve", str(folder / "plant.yaml"), merged=True) as agent:
        printed = agent.read_until(b"\n", count=2).splitlines()
        assert "warning: the certificate of agent line1" in printed[0]
        assert ", in 20 days; smartcam fleet certificates DIR" in printed[0]
        yield keys, printed[1].strip().removesuffix(f"/{CAMERA}")
        agent.send_signal(15)
        agent.wait()


@pytest.mark.long
def test_commands_of_each_role(plant: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    keys, url = plant
    assert url.startswith("fleet+tls://127.0.0.1:")
    assert "certificates" not in url  # those of the agent are not for programs
    monkeypatch.setenv("SMARTCAM_FLEET_CERTIFICATES", str(keys / "dashboard"))
    run("trigger", f"{url}/{CAMERA}").failed(5, "trigger is a command", "viewer dashboard")
    run("switch", f"{url}/{CAMERA}", "7").failed(5, "switch_application is a command")
    (one,) = run("fleet", "list", url, "--json").done().lines
    assert one["connected"]
    robot = f"?certificates={keys / 'robot'}"
    run("trigger", f"{url}/{CAMERA}{robot}").done()


@pytest.mark.long
def test_warning_of_list_and_doctor(plant: tuple[Path, str], tmp_path: Path) -> None:
    keys, url = plant
    (tmp_path / "authority").symlink_to(keys / "authority")
    make_certificates(tmp_path, {"viewer": ["office"]}, lifetime=timedelta(days=5.5))
    mine = f"?certificates={tmp_path / 'office'}"
    outcome = run("fleet", "list", f"{url}{mine}", "--json")
    assert outcome.code == 0
    assert "warning: the certificate of viewer office" in outcome.err
    assert ", in 5 days; smartcam fleet certificates" in outcome.err

    def doctor(*more: str) -> dict[str, dict[str, object]]:
        lines = run("doctor", *more, "--seconds", "0.1", "--json").out.splitlines()
        found: dict[str, dict[str, object]] = {}
        for one in map(json.loads, lines):
            found.setdefault(one["check"], one)
        return found

    own = doctor(f"{url}/{CAMERA}{mine}", "--trigger")
    assert own["certificates"]["text"] == "this program is viewer office: it may look"
    assert ", in 5 days;" in str(own["certificates"]["cure"])
    assert "Take the certificate of an operator" in str(own["reservation"]["cure"])
    theirs = doctor(f"{url}/{CAMERA}?certificates={keys / 'robot'}")
    assert theirs["certificates"]["text"] == (
        "this program is operator robot: it may look, and command"
    )
    assert "the agent's certificate ends on" in str(theirs["certificates"]["cure"])
    make_certificates(tmp_path / "strange", {"viewer": ["x"]})
    strange = doctor(f"{url}/{CAMERA}?certificates={tmp_path / 'strange' / 'x'}")
    assert "no handshake as viewer x: its certificate is of another" in str(strange["bus"]["text"])
