"""The wizard's site: the same steps over HTTP, and what it refuses."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import aiohttp
import pytest

from smartcam.calibration import Folder
from smartcam.calibration.wizards import CalibrationService, drift_wizard, plane_wizard
from smartcam.exceptions import NotRunningError
from smartcam.models import Header, Localization, Pose, Position, Quaternion
from smartcam.web import WizardSite
from smartcam.web._wizard import CALLS
from tests.web.sitekit import TOKEN

MARKS = [(0.0, 0.0), (0.2, 0.0), (0.0, 0.15), (0.2, 0.15)]
ABOUT = {"unit": "m", "touch_sigma": 0.2}


def files(folder: Path) -> list[str]:
    return [one.name for one in folder.iterdir()]


class World(NamedTuple):
    """A site and who calls it; ``broken`` makes the camera fail."""

    site: WizardSite
    session: aiohttp.ClientSession
    broken: list[Exception]

    async def call(self, method: str, path: str, body: object = None) -> tuple[int, Any]:
        options: dict[str, Any] = {} if body is None else {"json": body}
        url = f"{self.site.origin}/api{path}"
        async with self.session.request(method, url, **options) as response:
            return response.status, await response.json()

    async def post(self, path: str, **body: Any) -> Any:
        status, answer = await self.call("POST", path, body)
        assert status == 200, answer
        return answer


@contextlib.asynccontextmanager
async def served(folder: Path, token: str | None = None) -> AsyncIterator[World]:
    """Serve a wizard over a camera that sees four marks."""
    broken: list[Exception] = []
    pictures = itertools.count()

    async def localize() -> list[Localization]:
        if broken:
            raise broken.pop()
        header, noise = Header(1, datetime.now(UTC), "camera"), 1e-6 * next(pictures)
        return [
            Localization("mark", 1.0, 0, Pose(header, Position(x + noise, y), Quaternion()))
            for x, y in MARKS
        ]

    inside = Folder(folder)
    wizards = (
        plane_wizard(localize=localize, save_to=inside.calibration),
        drift_wizard(localize=localize, find=inside.find, record_to=inside.checks),
    )
    service = CalibrationService(inside, wizards)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    try:
        async with (
            WizardSite(service, token=token) as site,
            aiohttp.ClientSession(headers=headers) as session,
        ):
            yield World(site, session, broken)
    finally:
        service.close()


async def run_through(world: World, view: Any) -> Any:
    """Answer all steps of four marks, touched where y and x are swapped under the table."""
    touches = [{"x": y, "y": x, "z": 0.0} for x, y in MARKS]
    accept = {"next": "accept"}  # four marks are too few to be called good
    for answers in (ABOUT | {"side": "+z"}, {}, {}, *touches, accept, {}):
        view = await world.post("/step", token=view["token"], answers=answers)
        assert view["errors"] == {}
    return view


async def test_list_of_calls_has_every_call(tmp_path: Path) -> None:
    async with served(tmp_path) as world:
        _, answer = await world.call("GET", "")
    told = [(one["method"], one["path"]) for one in answer["calls"]]
    assert told == [(one.method, one.path) for one in CALLS]


async def test_wizard_over_http_makes_a_calibration_that_transforms(tmp_path: Path) -> None:
    async with served(tmp_path) as world:
        view = await world.post("/start", name="table", parameters={"robot_frame": "base"})
        assert (await world.call("GET", "/step"))[1] == view
        view = await run_through(world, view)
        assert (view["type"], view["result"]["points"]) == ("result", 4)
        assert (await world.call("GET", "/calibrations"))[1] == {
            "calibrations": ["table"], "wizards": ["plane", "drift"], "name": "table",
        }  # fmt: skip
        loaded = await world.post("/load", name="table")
        assert loaded == {"name": "table", "model": "rigid", "robot_frame": "base"}
        pose = (await world.post("/transform", x=0.1, y=0.05))["pose"]
        assert (pose["header"]["frame_id"], pose["position"]["x"]) == ("base", pytest.approx(0.05))
        listed = (await world.call("GET", "/listing"))[1]["listing"]
        assert [(one["name"], one["kind"], one["checked_at"]) for one in listed] == [
            ("table", "plane", None)
        ]
        exported = await world.post("/export", name="table", target="out.yaml")
    assert exported == {"file": "exports/out.yaml"}
    assert (tmp_path / "exports/out.yaml").read_text().startswith("%YAML 1.1\n")


async def test_check_over_http_says_that_a_knocked_camera_s_calibration_is_stale(
    tmp_path: Path,
) -> None:
    async with served(tmp_path) as world:
        await run_through(world, await world.post("/start", name="table"))
        view = await world.post("/start", name="table", wizard="drift")
        assert (view["wizard"], view["title"]) == ("drift", "Is table still true?")
        touches = [{"x": y + 0.002, "y": x, "z": 0.0} for x, y in MARKS]
        for answers in ({"unit": "m"}, {}, {}, *touches):
            view = await world.post("/step", token=view["token"], answers=answers)
        assert view["title"] == "table is stale"
        view = await world.post("/step", token=view["token"])
        assert (view["type"], view["result"]["stale"]) == ("result", True)
    assert {"table.journal", "table.drift.journal", "table.checks.jsonl"} < set(files(tmp_path))


async def test_answer_made_again_changes_nothing(tmp_path: Path) -> None:
    async with served(tmp_path) as world:
        view = await world.post("/start", name="table")
        body = {"token": view["token"], "answers": ABOUT}
        first = await world.post("/step", **body)
        assert await world.post("/step", **body) == first
        assert first["step"] == "picture"


async def test_failing_camera_keeps_the_step_and_is_reported(tmp_path: Path) -> None:
    async with served(tmp_path) as world:
        view = await world.post("/start", name="table")
        view = await world.post("/step", token=view["token"], answers=ABOUT)
        world.broken.append(NotRunningError("the camera is stopped"))
        view = await world.post("/step", token=view["token"])
        assert (view["step"], view["errors"]) == ("picture", {"base": "the camera is stopped"})


async def test_undo_repeat_and_abort_are_calls(tmp_path: Path) -> None:
    async with served(tmp_path) as world:
        view = await world.post("/start", name="table")
        view = await world.post("/step", token=view["token"], answers=ABOUT)
        view = await world.post("/step", token=view["token"])
        view = await world.post("/repeat", token=view["token"])
        assert view["step"] == "which"
        view = await world.post("/undo", token=view["token"])
        assert view["step"] == "picture"
        view = await world.post("/abort", token=view["token"])
        assert view["type"] == "abort"


@pytest.mark.parametrize(
    ("path", "body", "status", "code"),
    [
        ("/start", {"name": "../out"}, 422, "BAD_NAME"),
        ("/start", {"name": "table", "wizard": "eye"}, 404, "NOT_FOUND"),
        ("/step", {"token": "x"}, 409, "NO_SEQUENCE"),
        ("/undo", {"token": "x"}, 409, "NO_SEQUENCE"),
        ("/load", {"name": "/etc/passwd"}, 422, "BAD_NAME"),
        ("/load", {"name": "table"}, 404, "NOT_FOUND"),
        ("/export", {"name": "table", "target": "../x.json"}, 404, "NOT_FOUND"),
        ("/transform", {"x": 0, "y": 0}, 409, "NO_CALIBRATION"),
    ],
)
async def test_call_that_cannot_be_done_is_refused(
    tmp_path: Path, path: str, body: dict[str, Any], status: int, code: str
) -> None:
    async with served(tmp_path) as world:
        got, answer = await world.call("POST", path, body)
    assert (got, answer["fields"][0]["received"]) == (status, code)
    assert files(tmp_path) == []


async def test_old_token_is_refused(tmp_path: Path) -> None:
    async with served(tmp_path) as world:
        await world.post("/start", name="table")
        status, answer = await world.call("POST", "/undo", {"token": "old"})
    assert (status, answer["fields"][0]["received"]) == (409, "STALE_STEP")


async def test_unknown_field_is_refused(tmp_path: Path) -> None:
    async with served(tmp_path) as world:
        status, answer = await world.call("POST", "/start", {"name": "a", "path": "/"})
    assert (status, answer["fields"][0]["field"]) == (422, "path")


async def test_site_with_a_token_wants_it(tmp_path: Path) -> None:
    async with served(tmp_path, TOKEN) as world:
        assert (await world.call("GET", "/calibrations"))[0] == 200
        async with aiohttp.ClientSession() as stranger:
            other = World(world.site, stranger, [])
            assert (await other.call("POST", "/start", {"name": "table"}))[0] == 401
        assert world.site.url.endswith(f"#token={TOKEN}")
    assert files(tmp_path) == []


async def test_page_s_files_are_served(tmp_path: Path) -> None:
    async with served(tmp_path) as world:
        for path in ("/", "/wizard.js", "/wizard.css"):
            async with world.session.get(f"{world.site.origin}{path}") as response:
                assert response.status == 200
                assert len(await response.text()) > 500
