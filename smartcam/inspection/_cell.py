"""Read software cameras and their programs from a cell file or a fleet file (YAML)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from smartcam._arguments import (
    check_application_or_name,
    check_kind,
    check_path,
    check_text,
)
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.inspection._program import (
    MAX_TOOLS,
    FollowedApplication,
    Program,
    ProgramError,
    ProgramStep,
    make_step,
)
from smartcam.inspection._tool import ToolSetup
from smartcam.layout._inside import read_model

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from smartcam.calibration._inside import AnyCalibration

MAX_APPLICATIONS: Final = 1000
"""Largest number of applications of one camera."""

_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")


class ApplicationEntry(BaseModel):
    """An application of a software camera; its other keys are its tools, in running order."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="allow", frozen=True, hide_input_in_errors=True
    )

    name: str = Field(
        "", max_length=60, description="name of the application, by which others may follow it"
    )
    sequence: bool = Field(False, description="put the sequence number in front of the result")
    rate: float | None = Field(
        None,
        ge=0.0001,
        le=1000,
        allow_inf_nan=False,
        description="runs per second of a free-running application; default: it waits for triggers",
    )

    @property
    def tools(self) -> dict[str, Any]:
        """Settings of the tools by their keys, as in YAML."""
        return dict(self.model_extra or {})


def _check_folder(folder: str) -> str:
    if "\0" in folder:
        raise ValueError("expected the path of a folder, without a NUL character")
    return folder


class Keep(BaseModel):
    """Settings for keeping inspected pictures in a folder."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    folder: Annotated[str, AfterValidator(_check_folder)] = Field(
        min_length=1, description="folder beside this file, which is created if needed"
    )
    which: Literal["bad", "all"] = Field("bad", description="keep bad pictures only, or all")
    most: int = Field(
        1000,
        ge=1,
        le=1_000_000,
        description="largest number of pictures in the folder; the oldest are deleted",
    )


class SoftwareEntry(BaseModel):
    """A software camera as described by ``software:`` in a file."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    frames: str = Field(
        min_length=1,
        description="source of the pictures: gige://HOST, v4l2:///dev/video0, "
        "rtsp://HOST/..., or a file or folder beside this file",
    )
    calibration: str | None = Field(
        None,
        description="file with a calibration, beside this file: results are in the robot's metres",
    )
    applications: dict[int, ApplicationEntry] = Field(
        min_length=1,
        max_length=MAX_APPLICATIONS,
        description="applications by number: a name, and the tools in running order",
    )
    keep: Keep | None = Field(
        None, description="keep inspected pictures in a folder, with their findings"
    )
    drawn: bool = Field(
        True,
        description="draw the tools' marks into the pictures that a fleet shows",
    )

    def frames_address(self, folder: Path) -> str:
        """Return the address for :func:`smartcam.frames.open`.

        Args:
            folder: folder of the file.
        """
        return self.frames if _URL.match(self.frames) else str(folder / self.frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class CellCamera:
    """A software camera as its file describes it; the source of its pictures is not open.

    Attributes:
        name: name of the camera.
        frames: address for :func:`smartcam.frames.open`.
        calibration: calibration of the camera; None: not calibrated.
        programs: programs by the numbers of their applications.
        rates: runs per second of the free-running applications, by their numbers.
        keep: settings for keeping inspected pictures; None: keep none.
        folder: folder of the file.
    """

    name: str
    frames: str
    calibration: AnyCalibration | None
    programs: Mapping[int, Program]
    rates: Mapping[int, float] = field(default_factory=dict[int, float])
    keep: Keep | None = None
    folder: Path = Path()

    def program(self, application: int | str) -> Program:
        """Return the program of an application, by its number or name.

        Raises:
            ConfigurationError: there is no such application.
        """
        application = check_application_or_name(application, owner="program")
        for number, program in self.programs.items():
            if application in (number, str(number), program.name):
                return program
        known = [f"{number} ({program.name})" for number, program in self.programs.items()]
        raise ConfigurationError(
            f"{self.name}: no application {application!r:.60}; there are {', '.join(known)}"
        )


class _CellEntry(BaseModel):
    """The part of a camera's entry that describes a software camera; other keys are ignored."""

    software: SoftwareEntry | None = None


class _CellFile(BaseModel):
    cameras: dict[str, _CellEntry] = Field(min_length=1)


def load_cell(path: str | Path) -> dict[str, CellCamera]:
    """Return the software cameras of a cell file or a fleet file, by name.

    No source is opened, but the tools' models, taught pictures and calibrations are loaded.

    Raises:
        ConfigurationError: the file cannot be read, or a part of it is wrong; the text names file,
            line and field.
        MissingExtraError: an extra is not installed.
    """
    path = check_path(path, "path", "load_cell")
    cameras: dict[str, CellCamera] = {}

    def make_cameras(file: _CellFile) -> tuple[tuple[int | str, ...], str] | None:
        """Fill ``cameras``; return the keys and the text of the first mistake."""
        for name, entry in file.cameras.items():
            if entry.software is None:
                continue
            try:
                cameras[name] = make_camera(name, entry.software, path.parent)
            except ProgramError as exc:
                return ("cameras", name, "software", *exc.keys), str(exc)
        return None if cameras else (("cameras",), "expected a camera with software:, got none")

    read_model(path, "cell", _CellFile, "cameras", make_cameras)
    return cameras


def software_mistakes(
    name: str, software: SoftwareEntry, folder: Path
) -> Iterator[tuple[tuple[int | str, ...], str]]:
    """Yield the keys and text of each mistake in ``software:`` of a fleet file."""
    try:
        make_camera(name, software, folder)
    except ProgramError as exc:
        yield exc.keys, str(exc)


def make_camera(name: str, software: SoftwareEntry, folder: Path) -> CellCamera:
    """Return the camera that ``software:`` describes.

    Args:
        name: name of the camera.
        software: entry of the camera in the file.
        folder: folder of the file.

    Raises:
        ConfigurationError: the entry has a mistake. If the mistake has a place in the file, the
            error's ``keys`` lead to it.
        MissingExtraError: an extra is not installed.
    """
    check_kind(software, SoftwareEntry, "software", "a SoftwareEntry", "make_camera")
    folder = check_path(folder, "folder", "make_camera")
    name = check_text(name, "name", "make_camera")
    setup = ToolSetup(folder=folder, calibration=_calibration(software, folder))
    names = _numbers_by_name(software)
    steps_by_number: dict[int, list[ProgramStep]] = {}
    programs: dict[int, Program] = {}
    for number, entry in software.applications.items():
        steps = _make_steps(number, software, names, setup, steps_by_number, ())
        try:
            programs[number] = Program(
                number, entry.name or str(number), steps, sequence=entry.sequence
            )
        except ConfigurationError as exc:
            raise ProgramError(str(exc), ("applications", number)) from exc
    return CellCamera(
        name=name,
        frames=software.frames_address(folder),
        calibration=setup.calibration,
        programs=programs,
        rates={
            number: entry.rate
            for number, entry in software.applications.items()
            if entry.rate is not None
        },
        keep=software.keep,
        folder=folder,
    )


def _calibration(software: SoftwareEntry, folder: Path) -> AnyCalibration | None:
    if software.calibration is None:
        return None
    from smartcam.calibration import load_calibration

    try:
        return load_calibration(folder / software.calibration)
    except (SmartCamError, OSError) as exc:
        raise ProgramError(str(exc), ("calibration",)) from exc


def _numbers_by_name(software: SoftwareEntry) -> dict[str, int]:
    """Return the numbers of the applications that have a name, by this name."""
    names: dict[str, int] = {}
    for number, entry in software.applications.items():
        if not 0 <= number <= 0xFFFFFFFF:
            raise ProgramError("expected a number from 0 to 4294967295", ("applications", number))
        if entry.name and names.setdefault(entry.name, number) != number:
            raise ProgramError(
                f"the application {names[entry.name]} is called {entry.name!r}, too",
                ("applications", number, "name"),
            )
    return names


def _make_steps(
    number: int,
    software: SoftwareEntry,
    names: Mapping[str, int],
    setup: ToolSetup,
    steps_by_number: dict[int, list[ProgramStep]],
    followers: tuple[int, ...],
) -> list[ProgramStep]:
    """Return the steps of an application, which begin with the steps of followed applications.

    ``steps_by_number``: steps that were made already. ``followers``: applications that follow this
    one, to find circles.
    """
    if number in steps_by_number:
        return steps_by_number[number]
    keys = ("applications", number)
    entry = software.applications[number]
    if not 1 <= len(entry.tools) <= MAX_TOOLS:
        raise ProgramError(
            f"expected 1 to {MAX_TOOLS} tools, such as 'read:', got {len(entry.tools)}", keys
        )
    steps: dict[str, ProgramStep] = {}
    for key, given in entry.tools.items():
        try:
            step = make_step(key, given, setup, ApplicationEntry.model_fields)
        except ProgramError as exc:
            raise ProgramError(str(exc), (*keys, *exc.keys)) from exc
        follow = step.tool.settings.follow
        if follow is not None and follow not in steps:
            follow_keys = (*keys, key, "follow")
            other = names.get(follow)
            if other is None:
                known = [*steps, *names]
                raise ProgramError(
                    f"no tool before this one and no application is called {follow!r:.60}"
                    f"{did_you_mean(follow, known)}",
                    follow_keys,
                )
            if other == number or other in followers:
                raise ProgramError("the applications follow each other in a circle", follow_keys)
            followed = _make_steps(
                other, software, names, setup, steps_by_number, (*followers, number)
            )
            steps[follow] = ProgramStep(
                follow, FollowedApplication(followed, setup), in_result=False
            )
        if step.name in steps:
            raise ProgramError(
                f"there is a tool {step.name!r} already: expected another name after the kind of "
                f"tool, such as '{key.split()[0]} left:'",
                (*keys, key),
            )
        steps[step.name] = step
    steps_by_number[number] = [*steps.values()]
    return steps_by_number[number]
