"""The files of ``deploy/``: the unit, the containers, the settings of Prometheus."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from smartcam.fleet import load_fleet
from smartcam.fleet._operations import metrics
from tests import ROOT
from tests.cli.commandline import run
from tests.fleet.inside import OUTCOMES
from tests.fleet.inside import metric_families as families

DEPLOY = ROOT / "deploy"


def unit() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in (DEPLOY / "smartcam-agent.service").read_text("utf-8").splitlines():
        name, sign, value = line.partition("=")
        if sign and not line.startswith("#"):
            found.setdefault(name, []).append(value)
    return found


def read(name: str) -> Any:
    return yaml.safe_load((DEPLOY / name).read_text("utf-8"))


def test_the_fleet_file_of_the_composition_is_one() -> None:
    file = load_fleet(DEPLOY / "fleet.yaml")
    assert [one.name for one in file.plan()] == ["demo/cam1", "demo/cam2"]
    assert file.operations is not None
    (target,) = read("prometheus.yml")["scrape_configs"][0]["static_configs"][0]["targets"]
    assert target == f"agent:{(file.operations.endpoint or ('', 0))[1]}"


def test_commands_in_unit_and_containers_are_ours() -> None:
    (start,) = unit()["ExecStart"]
    containerfile = (DEPLOY / "Containerfile").read_text("utf-8")
    entry = re.findall(r"^(?:ENTRYPOINT|CMD) (\[.*\])$", containerfile, re.MULTILINE)
    commands = [
        shlex.split(start)[1:],
        [word for part in entry for word in yaml.safe_load(part)][1:],
        read("compose.yaml")["services"]["page"]["command"],
    ]
    for words in commands:
        name, *rest = words
        options = [word.partition("=")[0] for word in rest if word.startswith("--")]
        shown = run(name, "--help").out
        assert "Usage" in shown
        for option in options:
            assert option in shown, words


def test_what_the_alarms_look_at_is_there() -> None:
    (group,) = read("alerts.yml")["groups"]
    source = Path(families.__file__).read_text("utf-8")
    for rule in group["rules"]:
        for name in re.findall(r"smartcam_\w+", rule["expr"]):
            assert f'"{re.sub("_(total|bucket)$", "", name)}"' in source, rule["alert"]
        for words in re.findall(r'outcome!?~"(.*?)"', rule["expr"]):
            assert set(words.split("|")) <= set(OUTCOMES)
        for words in re.findall(r'fate!?~"(.*?)"', rule["expr"]):
            assert set(words.split("|")) <= set(metrics.FATES)


@pytest.mark.long
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("no systemd-analyze: apt-get install systemd")
    text = (DEPLOY / "smartcam-agent.service").read_text("utf-8")
    copy = tmp_path / "smartcam-agent.service"
    copy.write_text(text.replace("/opt/smartcam/bin/smartcam", "/bin/true"), "utf-8")
    done = subprocess.run(  # noqa: S603 - a tool of the system's
        [analyze, "verify", str(copy)], capture_output=True, text=True, check=False, timeout=60
    )
    said = [line for line in done.stderr.splitlines() if "smartcam-agent" in line]
    assert (done.returncode, said) == (0, [])
