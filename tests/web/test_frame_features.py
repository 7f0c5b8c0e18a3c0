"""Features and triggers of a GigE camera by the page's calls, and on the page in a browser."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest

import smartcam.frames
from smartcam.web import FramesSite
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import camera
from tests.web.sitekit import Caller

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.frames import FrameSource
    from tests.frames.gige.camera import Camera

pytest.importorskip("simplejpeg", reason="needs the extra frames")


@contextlib.asynccontextmanager
async def site(
    *, changes: bool = True, query: str = "&trigger=software"
) -> AsyncIterator[tuple[Camera, FrameSource, Caller, FramesSite]]:
    async with (
        camera() as there,
        smartcam.frames.open(
            f"gige://127.0.0.1:{there.port}?packet_size=576{query}", linger=10
        ) as source,
        FramesSite([source], changes=changes) as made,
        aiohttp.ClientSession() as session,
    ):
        yield there, source, Caller(made, session, ""), made


async def test_features_are_read_and_set_by_calls() -> None:
    async with site() as (there, source, caller, _):
        (told,) = (await caller.get("/api/sources"))["sources"]
        assert told["features"] is True
        answer = await caller.get("/api/sources/0/features")
        assert answer["settable"] is True
        by_name = {one["name"]: one for one in answer["features"]}
        assert by_name["BlackLevel"]["range"] == "0 to 25.5 DN"
        assert by_name["TriggerMode"]["value"] == "On"
        for name, value, has in (
            ("BlackLevel", 1.23, 1.2),
            ("black_level", "2.5", 2.5),
            ("ReverseX", True, True),
            ("Width", 128, 128),
        ):
            body = {"name": name, "value": value}
            done = await caller.call("POST", "/api/sources/0/feature", json=body)
            assert (done.status, done.value) == (200, {"value": has})
        done = await caller.call("POST", "/api/sources/0/command", json={"name": "UserSetSave"})
        assert done.status == 200
        assert there.kept[0][cameras.BLACK] == 25
        assert source.format.width == 128


async def test_a_trigger_answers_its_picture() -> None:
    async with site() as (there, _, caller, made):
        url = caller.url("/api/sources/0/trigger")
        for number in (1, 2):
            async with caller.session.post(url, headers={"Origin": made.url.rstrip("/")}) as answer:
                assert (answer.status, answer.content_type) == (200, "image/jpeg")
                assert answer.headers["Frame-Sequence"] == str(there.exposed[number])


@pytest.mark.parametrize(
    ("path", "body", "status", "text"),
    [
        ("feature", {"name": "Width", "value": 100}, 422, "in steps of 8, got 100"),
        ("feature", {"name": "Widht", "value": 64}, 422, "did you mean 'Width'"),
        ("feature", {"name": "Width"}, 422, "value"),
        ("feature", {"name": "", "value": 1}, 422, "name"),
        ("feature", {"name": "Width", "value": None}, 422, "value"),
        ("command", {"name": "Width"}, 422, "it is no command"),
    ],
)
async def test_what_cannot_be_done_is_reported(
    path: str, body: dict[str, Any], status: int, text: str
) -> None:
    async with site() as (_, _, caller, _):
        answer = await caller.call("POST", f"/api/sources/0/{path}", json=body)
        assert answer.status == status
        assert text in answer.value["error"]


async def test_nothing_is_changed_unless_it_was_allowed() -> None:
    async with site(changes=False) as (there, _, caller, _):
        assert (await caller.get("/api/sources/0/features"))["settable"] is False
        before = dict(there.words)
        for path, body in (
            ("feature", {"name": "Width", "value": 128}),
            ("command", {"name": "UserSetSave"}),
            ("trigger", {}),
        ):
            answer = await caller.call("POST", f"/api/sources/0/{path}", json=body)
            assert answer.status == 403
        assert there.words == before


async def test_a_source_without_features_reports_it() -> None:
    async with (
        smartcam.frames.open("synthetic://") as source,
        FramesSite([source], changes=True) as made,
        aiohttp.ClientSession() as session,
    ):
        caller = Caller(made, session, "")
        (told,) = (await caller.get("/api/sources"))["sources"]
        assert told["features"] is False
        answer = await caller.call("GET", "/api/sources/0/features")
        assert (answer.status, "has no features" in answer.value["error"]) == (422, True)
        answer = await caller.call("POST", "/api/sources/0/trigger")
        assert (answer.status, "has no trigger" in answer.value["error"]) == (422, True)
