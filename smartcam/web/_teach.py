"""Serve the page on which people teach an application: they draw regions, and try tools."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from aiohttp import web
from pydantic import Field

from smartcam._extras import from_part, load
from smartcam.exceptions import ConfigurationError, FrameSourceError, SmartCamError
from smartcam.models import jsonable
from smartcam.web._errors import RefusedError
from smartcam.web._routes import CallBody, CallRequest, Calls
from smartcam.web._site import API
from smartcam.web._threaded_site import ThreadedSite

with from_part("inspection", "teaching needs"):
    from smartcam.inspection import Picture
    from smartcam.inspection._inside import (
        learn_tolerances,
        read_settings,
        setting_text,
        tool_settings,
    )

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from smartcam.frames import FrameSource
    from smartcam.inspection import Drawing, Inspection
    from smartcam.inspection._inside import Teaching

MAX_PICTURES: Final = 200
"""Largest number of pictures on the page. When a new one is taken, the oldest is dropped."""

MAX_TOOLS: Final = 32
"""Largest number of tools that the page may try at once."""

MAX_MARKS: Final = 400
"""Largest number of marks of a picture that the page draws."""

MAX_POINTS: Final = 200
"""Largest number of points of a mark that the page draws."""

SHOT_TIMEOUT: Final = 5.0
"""Seconds to wait for a picture of the camera."""

T = TypeVar("T")


class NamedPicture:
    """A picture on the page.

    Args:
        name: name of the picture for people.
        picture: pixels of the picture.
        file: path by which a cell file names its file; "" without a file.
    """

    def __init__(self, name: str, picture: Picture, file: str = "") -> None:
        self.name = name
        self.picture = picture
        self.file = file


class TeachSite(ThreadedSite):
    """A page that teaches an application of a software camera.

    Args:
        teaching: the application and its file.
        files: files with pictures.
        source: open source of the camera's frames, for new pictures; None: files only.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        token: token that every call must carry in ``Authorization: Bearer``, as for
            :class:`~smartcam.web.LiveSite`.

    Raises:
        ConfigurationError: the token cannot be used, or there are too many files.
        FrameFormatError: a file is no picture.

    Attributes:
        teaching: the application and its file.
        pictures: pictures on the page, by their numbers.
    """

    def __init__(
        self,
        teaching: Teaching,
        files: Iterable[str | Path] = (),
        *,
        source: FrameSource | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(CALLS, "teach", host=host, port=port, token=token)
        self.teaching: Teaching = teaching
        self.source: FrameSource | None = source
        paths = [Path(file) for file in files]
        if len(paths) > MAX_PICTURES:
            raise ConfigurationError(f"teach: expected {MAX_PICTURES} pictures at most")
        folder = teaching.path.parent
        named = [
            NamedPicture(path.name, Picture.read(path), _path_in_cell_file(path, folder))
            for path in paths
        ]
        self.pictures: dict[int, NamedPicture] = dict(enumerate(named, start=1))
        self._number = len(named)  # number of the newest picture
        # what the tools found when they were last tried, by the picture's number
        self._last_inspections: dict[int, Inspection] = {}

    async def work(self, what: Callable[..., T], *args: object) -> T:
        """Run a function in the thread.

        Raises:
            RefusedError: the call cannot be carried out, or the site is stopped.

        Cancellation: safe; a function that has begun runs to its end.
        """
        try:
            return await self.in_thread(what, *args)
        except SmartCamError as exc:
            raise RefusedError(422, str(exc), "tools that can work") from exc

    async def shoot(self) -> int:
        """Add the camera's next frame to the pictures; return its number.

        Raises:
            RefusedError: there is no frame.
        """
        if self.source is None:
            raise RefusedError(409, "a new picture", "a page with a camera; this one has files")
        try:
            frame = await self.source.newest(max_age=0.5, timeout=SHOT_TIMEOUT)
        except FrameSourceError as exc:
            raise RefusedError(409, str(exc), "a source that gives frames") from exc
        picture = await self.work(Picture.of, frame)
        self._number += 1
        self.pictures[self._number] = NamedPicture(f"picture {self._number}", picture)
        if len(self.pictures) > MAX_PICTURES:
            del self.pictures[next(iter(self.pictures))]
        return self._number

    def picture(self, number: str) -> NamedPicture:
        """Return a picture by its number.

        Raises:
            RefusedError: there is no such picture.
        """
        named = self.pictures.get(int(number)) if number.isdecimal() else None
        if named is None:
            raise RefusedError(404, f"picture {number:.20}", "one of those that are listed")
        return named

    def try_tools(self, tools: dict[str, dict[str, str]]) -> dict[str, Any]:
        """Return the tools' findings in every picture, and remarks; call it in a thread.

        Raises:
            ConfigurationError: a tool or setting is wrong.
        """
        program = self.teaching.program(read_settings(tools))
        results: list[dict[str, Any]] = []
        inspections: dict[int, Inspection] = {}
        for number, named in list(self.pictures.items()):
            try:
                inspection = inspections[number] = program.inspect(named.picture)
            except SmartCamError as exc:
                results.append({"picture": number, "ok": False, "reason": str(exc), "marks": []})
                continue
            results.append(
                {
                    "picture": number,
                    "ok": inspection.ok,
                    "reason": inspection.reason,
                    "values": jsonable(inspection.value),
                    "milliseconds": 1e3 * sum(inspection.seconds.values()),
                    "marks": _marks(inspection),
                }
            )
        self._last_inspections = inspections
        remarks = [text for step in program.steps for text in step.tool.remarks]
        return {"found": results, "remarks": remarks}

    def learn(self, tools: dict[str, dict[str, str]], good: list[int]) -> dict[str, Any]:
        """Return settings, as texts, with which the good pictures pass, and remarks about them.

        Raises:
            ConfigurationError: a tool or setting is wrong.
        """
        self.try_tools(tools)
        inspections = {
            f"{number}: {self.pictures[number].name}": self._last_inspections[number]
            for number in good
            if number in self._last_inspections
        }
        if not inspections:
            raise ConfigurationError("expected good pictures to learn from, got none")
        lesson = learn_tolerances(read_settings(tools), inspections)
        return {"tools": texts_of(lesson.tools), "learned": lesson.remarks}

    def state(self) -> dict[str, Any]:
        """Return the state with which the page begins, as values for JSON."""
        teaching = self.teaching
        return {
            "file": str(teaching.path),
            "camera": teaching.camera,
            "application": teaching.application,
            "name": teaching.name,
            "tools": texts_of(teaching.tools),
            "kinds": tool_settings(),
            "live": self.source is not None,
            "pictures": [
                {"number": key, "name": named.name, "size": named.picture.size, "file": named.file}
                for key, named in self.pictures.items()
            ],
        }


def _path_in_cell_file(path: Path, folder: Path) -> str:
    """Return the path by which a cell file in ``folder`` names a picture."""
    path, folder = path.resolve(), folder.resolve()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def texts_of(tools: dict[str, dict[str, Any]]) -> dict[str, dict[str, str]]:
    """Return the settings of tools as texts in YAML."""
    return {
        key: {name: setting_text(value) for name, value in settings.items()}
        for key, settings in tools.items()
    }


def _marks(inspection: Inspection) -> list[dict[str, Any]]:
    """Return the marks of the tools, as values for JSON."""
    drawn = [drawing for finding in inspection.findings.values() for drawing in finding.drawings]
    return [_mark(drawing) for drawing in drawn[:MAX_MARKS]]


def _mark(drawing: Drawing) -> dict[str, Any]:
    points = [[round(x, 2), round(y, 2)] for x, y in drawing.points[:MAX_POINTS]]
    texts = {"kind": drawing.kind, "role": drawing.role, "text": drawing.text}
    return {**texts, "points": jsonable(points)}


def _png(picture: Picture) -> bytes:
    pixels = picture.rgb[:, :, ::-1] if picture.has_colours else picture.grey
    cv2 = load("cv2", "inspection needs")
    _, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return bytes(data)


# ---------------------------------------------------------------------- calls

CALLS: Calls[TeachSite] = Calls()
"""All calls."""


class ToolsBody(CallBody):
    """Tools by their keys; each setting is a text in YAML."""

    tools: dict[str, dict[str, str]] = Field(max_length=MAX_TOOLS)


class LearnBody(ToolsBody):
    """Tools, and the pictures of good parts to learn their tolerances from."""

    good: list[int] = Field(max_length=MAX_PICTURES)


_SAMPLE = '{"tools": {"present": {"region": "[10, 10, 80, 60]", "grey": "[0, 90]"}}}'


@CALLS.add("GET", API)
def _calls(_site: TeachSite, _call: CallRequest) -> object:
    """List the calls of this page."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/state")
def _state(site: TeachSite, _call: CallRequest) -> object:
    """The application's entry in the file, the kinds of tools, and the pictures."""
    return site.state()


@CALLS.add("GET", f"{API}/pictures/{{number}}")
async def _picture(site: TeachSite, call: CallRequest) -> web.Response:
    """A picture, as a PNG."""
    data = await site.work(_png, site.picture(call.path["number"]).picture)
    return web.Response(body=data, content_type="image/png")


@CALLS.add("POST", f"{API}/pictures")
async def _shoot(site: TeachSite, _call: CallRequest) -> object:
    """Take a picture with the camera now."""
    return {"number": await site.shoot(), **site.state()}


@CALLS.add("POST", f"{API}/try", body=ToolsBody, sample=_SAMPLE)
async def _try(site: TeachSite, call: CallRequest) -> object:
    """Verdicts and values of the tools for every picture, and remarks."""
    return await site.work(site.try_tools, call.body.tools)


@CALLS.add(
    "POST", f"{API}/learn", body=LearnBody, sample=_SAMPLE.replace("}}}", '}}, "good": [1]}')
)
async def _learn(site: TeachSite, call: CallRequest) -> object:
    """The tools with tolerances that all good pictures pass, and their reasons."""
    return await site.work(site.learn, call.body.tools, call.body.good)


@CALLS.add("POST", f"{API}/save", body=ToolsBody, sample=_SAMPLE)
async def _save(site: TeachSite, call: CallRequest) -> object:
    """Write the tools into the file; its comments stay."""
    settings = read_settings(call.body.tools)
    await site.work(site.teaching.save, settings)
    return {"saved": str(site.teaching.path)}
