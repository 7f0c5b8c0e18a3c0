"""A log as lines of JSON: its fields, from any thread, and without a reader."""

from __future__ import annotations

import json
import logging
import os
import re
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from smartcam._cli import log_lines
from smartcam._cli.log_lines import FIELDS, MAX_TEXT_CHARACTERS, json_log
from smartcam.exceptions import ConnectionLostError

LOGGER = logging.getLogger("smartcam.client")
CAMERAS = {"line1/cam1", "line1/cam2"}


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reading, writing = os.pipe()
    yield reading, writing
    os.close(reading)
    os.close(writing)


def written(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def logged(path: Path, *records: Any) -> list[dict[str, Any]]:
    with (
        path.open("wb") as file,
        json_log(logging.INFO, lambda: "a1", lambda: CAMERAS, descriptor=file.fileno()),
    ):
        for one in records:
            one()
    return written(path)


def test_a_line_has_the_fields_of_the_table(tmp_path: Path) -> None:
    def fail() -> None:
        try:
            raise ValueError("it broke")
        except ValueError:
            LOGGER.exception("%s ! %s failed", "line1/cam1", "trigger")

    before = datetime.now(UTC)
    lines = logged(
        tmp_path / "log",
        lambda: LOGGER.info("%s = connected to %s", "line1/cam2", "bvs://h"),
        fail,
        lambda: LOGGER.debug("left out"),
        lambda: logging.getLogger("asyncio").warning("something else\nin two lines"),
        lambda: LOGGER.warning("! %s", ConnectionLostError("line1/cam1: the link ended")),
        lambda: LOGGER.warning("by hand", extra={"camera": "line1/cam2"}),
        lambda: LOGGER.warning("%d arguments", "that do not fit"),
        lambda: LOGGER.warning("%s", "x" * (MAX_TEXT_CHARACTERS + 10)),
    )
    assert [one["camera"] for one in lines] == [
        *("line1/cam2", "line1/cam1", None, "line1/cam1", "line1/cam2", None, None)
    ]
    first, failed, other, *_, wrong, long = lines
    assert [*first] == [one for one in FIELDS if one not in {"exception", "dropped"}]
    assert [*failed] == [one for one in FIELDS if one != "dropped"]
    assert abs((datetime.fromisoformat(first["time"]) - before).total_seconds()) < 60
    assert datetime.fromisoformat(first["time"]).tzinfo is not None
    assert (first["level"], first["logger"]) == ("info", "smartcam.client")
    assert first["message"] == "line1/cam2 = connected to bvs://h"
    assert failed["message"] == "line1/cam1 ! trigger failed"
    assert failed["exception"].startswith("Traceback")
    assert failed["exception"].endswith("ValueError: it broke")
    assert other["message"] == "something else\nin two lines"
    assert "that do not fit" in wrong["message"]
    assert len(long["message"]) == MAX_TEXT_CHARACTERS
    assert {one["agent"] for one in lines} == {"a1"}


def test_the_documents_have_these_fields() -> None:
    page = (Path(__file__).parents[2] / "docs" / "operations.md").read_text("utf-8")
    table = page.partition("\n| field |")[2].partition("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == set(FIELDS)


@pytest.mark.real_time
def test_any_thread_logs_whole_lines(tmp_path: Path) -> None:
    def work(number: int) -> None:
        for step in range(200):
            LOGGER.info("%d %d", number, step)

    def all_at_once() -> None:
        threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
        for one in threads:
            one.start()
        for one in threads:
            one.join()

    lines = logged(tmp_path / "log", all_at_once)
    said = [one["message"].split() for one in lines]
    assert len(said) == 1600
    for number in range(8):  # each in its own order
        assert [int(step) for who, step in said if who == str(number)] == [*range(200)]


@pytest.mark.real_time
def test_a_pipe_that_nobody_reads_holds_nobody_up_and_what_was_dropped_is_told(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_lines, "CLOSE_TIMEOUT", 0.01)
    reading, writing = pipe
    with json_log(logging.INFO, str, set, descriptor=writing, max_lines=50) as handler:
        for number in range(3000):  # more than a pipe and the queue hold
            LOGGER.info("%d %s", number, "x" * 100)
        assert handler.dropped_count > 0
        said: list[int] = []
        lost = 0
        with os.fdopen(os.dup(reading), encoding="utf-8") as file:
            while len(said) + lost < 3000:
                line = json.loads(file.readline())
                if "dropped" in line:
                    lost += line["dropped"]
                    count = line["dropped"]
                    assert line["message"].startswith(f"{count} lines of this log were dropped")
                    assert (line["level"], line["logger"]) == ("warning", "smartcam.log")
                else:
                    said.append(int(line["message"].split()[0]))
            assert said == sorted(set(said))
            assert lost == handler.dropped_count
            LOGGER.info("and on")
            assert json.loads(file.readline())["message"] == "and on"
    # nobody reads any more: the end does not wait
    with json_log(logging.INFO, str, set, descriptor=writing, max_lines=50) as handler:
        for number in range(3000):
            LOGGER.info("%d %s", number, "x" * 100)
    assert not handler._finished.is_set()
    while not handler._finished.is_set():  # let the thread go
        os.read(reading, 1 << 16)


def test_what_logged_before_logs_again_afterwards(tmp_path: Path) -> None:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    logged(tmp_path / "log", lambda: LOGGER.info("here"))
    assert (root.handlers, root.level) == before
