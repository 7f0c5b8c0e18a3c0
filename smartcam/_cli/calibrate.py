"""``smartcam calibrate``: the wizards of a calibration in the terminal, or on a web page."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.calibrate_files import (
    DEFAULT_COMMAND,
    WIZARDS,
    DefaultCommand,
    DefaultCommandContext,
    GroupWithDefault,
    compare,
    draw,
)
from smartcam._cli.calibrate_lens import lens as calibrate_lens
from smartcam._cli.calibrate_lens import read_target
from smartcam._cli.calibrate_terminal import listing_text, run_wizard
from smartcam._cli.frame_sources import is_source, make_source
from smartcam._cli.options import (
    CONNECT_WARNING,
    OUTPUT_OPTIONS,
    Options,
    async_command,
    label_file_errors,
    option,
)
from smartcam._cli.page import PageOptions, page_options
from smartcam.exceptions import CalibrationError, ConfigurationError, UnsupportedError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from smartcam.calibration import Folder
    from smartcam.calibration._inside import Lens
    from smartcam.calibration.wizards import CalibrationService, Wizard, WizardSession
    from smartcam.frames import FrameSource
    from smartcam.models import Localization

ABORT_EXIT_CODE = 130
"""Exit code after an abort, as after Ctrl-C: there is no calibration."""

STALE_EXIT_CODE = 7
"""Exit code after a check that found the calibration out of date."""

LINGER_TIME = 30.0
"""Seconds for which a source of frames keeps streaming after a picture: then the next picture
needs no new start, and exposure and white balance stay the same."""

HELP = "Calibrate a camera against a robot: where its localizations lie in the robot's space. "


@click.command(
    cls=DefaultCommand,
    hidden=True,
    help=f"{HELP}"
    "Asks step by step; each answer is saved before the next step is shown, so the same "
    "command continues after an interruption. Instead of an answer, :undo, :repeat and :abort are "
    "understood. With --json each step is a line of stdout and each line of stdin "
    '{"answers": {...}} or {"do": "undo"|"repeat"|"abort"}, each with the "token" of its '
    "step, or without one for the current step. "
    "With --check it asks for a few touches only, and reports whether a calibration still holds: "
    f"exit code {STALE_EXIT_CODE} if it is stale. "
    "With --wizard sheet or hand-eye it uses pictures: those of a camera "
    "that sends them, or those of --pictures, which arrive in a folder or are the frames of a "
    "source (see smartcam frames); then no URL is needed. "
    f"The camera is connected for each picture only. {CONNECT_WARNING}",
)
@click.argument("url", required=False)
@click.option(
    "--name", "calibration_name", metavar="NAME", help="Name to save by.  [default: the wizard's]"
)
@click.option(
    "--wizard",
    type=click.Choice(WIZARDS),
    help="Kind of calibration: a plane from localizations, a plane from a picture of a "
    "printed sheet, or a camera on a robot or beside it.  [default: plane]",
)
@click.option(
    "--pictures",
    metavar="FOLDER|URL",
    type=click.Path(file_okay=False),
    help="Take the next picture that arrives in this folder, such as by FTP; or the next frame of "
    "this source, such as v4l2:///dev/video0.",
)
@click.option(
    "--target",
    metavar="FILE",
    type=click.Path(dir_okay=False),
    help="Description of the sheet, as smartcam sheet --describe writes it.",
)
@click.option(
    "--lens",
    metavar="FILE",
    type=click.Path(dir_okay=False),
    help="The camera's lens: a camera_info of ROS, a calibration of smartcam, or a file of another "
    "program whose format is known.",
)
@click.option("--check", metavar="NAME", help="Check the calibration of that name.")
@click.option(
    "--folder",
    type=click.Path(file_okay=False),
    default="calibrations",
    show_default=True,
    help="Folder of calibrations and journals; created if missing.",
)
@click.option(
    "--list",
    "list_only",
    is_flag=True,
    help="Only list the calibrations of the folder: date, error, last check.",
)
@page_options("Serve a page instead of asking here, until Ctrl-C; its address goes to stdout.")
@click.option("--fresh", is_flag=True, help="Begin anew, even after an interruption.")
@click.option("--feature", metavar="ID", help="Only localizations of this feature are marks.")
@option("--application", help="Run this application for each picture.")
@option(
    "--interpret-as",
    default="localizations",
    show_default=True,
    help="Interpretation of results; must give localizations.",
)
@option("--y-down")
@option(
    "--timeout",
    help="Longest time for each step of a picture: connect (default 10), switch (10), trigger (5).",
)
@async_command(*OUTPUT_OPTIONS)
async def wizard_command(
    url: str | None,
    calibration_name: str | None,
    wizard: str | None,
    pictures: str | None,
    target: str | None,
    lens: str | None,
    check: str | None,
    folder: str,
    list_only: bool,
    fresh: bool,
    feature: str | None,
    web: PageOptions,
    options: Options,
) -> None:
    """Calibrate a camera against a robot."""
    if list_only:
        _list(folder, options)
        return
    if calibration_name is not None and check is not None:
        raise click.UsageError("--check names the calibration already: leave out --name")
    if wizard is not None and check is not None:
        raise click.UsageError("--check has its own steps, touches of marks: leave out --wizard")
    if url is not None and _is_frame_source(url):
        from smartcam.frames import FrameAddress

        address = FrameAddress.parse(url).shown
        raise ConfigurationError(
            f"{address} gives frames, no localizations: expected the URL of a camera that does, or "
            f"--pictures {address} with --wizard sheet or --wizard hand-eye"
        )
    if url is None and (pictures is None or wizard in {None, "plane"}):
        raise click.UsageError(
            "a URL is missing: only --wizard sheet and --wizard hand-eye need none, with "
            "--pictures FOLDER or --pictures URL"
        )
    async with _open_frames(pictures, options) as source:
        sources = _Sources(options, url, pictures, source, target, lens)
        await _run(sources, calibration_name, wizard, check, folder, feature, fresh, web)


async def _run(
    sources: _Sources,
    calibration_name: str | None,
    wizard: str | None,
    check: str | None,
    folder: str,
    feature: str | None,
    fresh: bool,
    web: PageOptions,
) -> None:
    """Run the wizard on its page or in the terminal until it ends."""
    from smartcam.calibration._inside import VERIFICATION_WIZARD

    options = sources.options
    wizard_name = VERIFICATION_WIZARD if check is not None else wizard or "plane"
    parameters: dict[str, Any] = {} if feature is None else {"feature": feature}
    if sources.target is not None and wizard_name in {"sheet", "hand-eye"}:
        parameters["target"] = sources.target_data
    saved_name = next(name for name in (check, calibration_name, wizard_name) if name is not None)
    try:
        service = _make_service(folder, sources)
        try:
            if check is not None:
                options.check_y_down(service.load(check), f"--check {check}")
            service.start(saved_name, wizard_name, parameters, fresh=fresh)
            if web.is_wanted:
                await _serve(service, options, web)
            else:

                def restart() -> WizardSession:
                    service.start(saved_name, wizard_name, parameters, fresh=True)
                    return service.session

                picture = Path(folder) / f"{saved_name}.step.svg"
                _exit_with_code(await run_wizard(service.session, options, restart, picture))
        finally:
            service.close()
    except CalibrationError as exc:
        raise ConfigurationError(str(exc)) from exc


def _is_frame_source(url: str) -> bool:
    """Return True if a URL names a source of frames and not a camera."""
    from smartcam.registry import FRAMES, PROTOCOLS
    from smartcam.settings import is_fleet

    scheme = url.partition("://")[0] if is_source(url) else ""
    return scheme in FRAMES and scheme not in PROTOCOLS and not is_fleet(url)


@contextlib.asynccontextmanager
async def _open_frames(pictures: str | None, options: Options) -> AsyncIterator[FrameSource | None]:
    """Open the source of frames that ``--pictures`` names; None if it names no source.

    Raises ConfigurationError: the URL is wrong; FrameSourceError: the source does not exist.
    """
    if pictures is None or not is_source(pictures):
        yield None
        return
    async with make_source(pictures, options, linger=LINGER_TIME) as source:
        yield source


wizard_command.context_class = DefaultCommandContext
calibrate = GroupWithDefault(
    "calibrate",
    commands={
        DEFAULT_COMMAND: wizard_command,
        "lens": calibrate_lens,
        "compare": compare,
        "draw": draw,
    },
    help=HELP,
)


def _list(path: str, options: Options) -> None:
    from smartcam.calibration import Folder
    from smartcam.calibration._inside import list_calibrations

    if not Path(path).is_dir():
        raise ConfigurationError(f"--folder {path}: no such folder")
    rows = list_calibrations(Folder(path))
    if options.as_json:
        for row in rows:
            options.show(row, "")
    else:
        click.echo(listing_text(rows) if rows else f"no calibrations in {path}")


def _exit_with_code(view: Mapping[str, Any]) -> None:
    if view["type"] == "abort":
        raise SystemExit(ABORT_EXIT_CODE)
    if view["result"].get("stale"):
        raise SystemExit(STALE_EXIT_CODE)


async def _serve(service: CalibrationService, options: Options, web: PageOptions) -> None:
    from smartcam.web import WizardSite

    async with WizardSite(service, **web.site_arguments) as site:
        options.show({"page": site.url}, f"page: {site.url}")
        await asyncio.Event().wait()


def _make_service(folder: str, sources: _Sources) -> CalibrationService:
    from smartcam._extras import load
    from smartcam.calibration import Folder
    from smartcam.calibration.wizards import CalibrationService

    load("scipy")  # fails before anything is measured
    with label_file_errors(f"--folder {folder}"):
        calibrations = Folder(folder)
    return CalibrationService(calibrations, sources.wizards(calibrations))


@dataclass(frozen=True, slots=True)
class _Sources:
    """The sources of localizations and pictures, the target and the lens of the options."""

    options: Options
    url: str | None
    pictures: str | None
    source: FrameSource | None
    target: str | None
    lens: str | None

    @property
    def target_data(self) -> dict[str, Any]:
        """Description of the sheet, as plain data."""
        from smartcam.calibration import target_to_data

        return target_to_data(read_target(str(self.target)))

    def wizards(self, folder: Folder) -> list[Wizard]:
        """Return the wizards that can run with these options; the first is the page's default.

        Raises ConfigurationError: a file of the options cannot be used.
        """
        from smartcam.calibration.wizards import (
            drift_wizard,
            hand_eye_wizard,
            plane_wizard,
            sheet_wizard,
        )

        wizards: list[Wizard] = []
        connect: dict[str, Any] | None = None
        if self.url is not None:
            with self.options.camera(self.url):  # raises for a wrong address or option
                y_down = self.options.y_down
            connect = {"url": self.url} | {
                name: getattr(self.options, name)
                for name in ("application", "interpret_as", "y_down")
            }
            wizards = [
                plane_wizard(
                    localize=self.localize,
                    save_to=folder.calibration,
                    y_down=y_down,
                    connect=connect,
                ),
                drift_wizard(
                    localize=self.localize,
                    find=folder.find,
                    record_to=folder.checks,
                    y_down=y_down,
                ),
            ]
        target = None if self.target is None else read_target(self.target)
        lens = None if self.lens is None else _read_lens(self.lens)
        pictures: dict[str, Any] = {
            **self._picture_arguments(),
            "save_to": folder.calibration,
            "suggested": target,
            "camera": None if lens is None else lens.camera,
        }
        known = None if lens is None else lens.covariance
        sheet = sheet_wizard(**pictures, lens_covariance=known, connect=connect)
        return [*wizards, sheet, hand_eye_wizard(**pictures)]

    async def localize(self) -> list[Localization]:
        from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
        from smartcam.models import Localization

        options = self.options
        with options.camera(str(self.url)) as unopened_camera:
            async with unopened_camera as camera:
                # the agent of a fleet knows the direction of y
                if camera.settings.y_down != options.y_down:
                    raise ConfigurationError(
                        f"{camera.url}: its agent has y_down: true: give --y-down here, too; "
                        "otherwise the calibration is mirrored"
                    )
                result = await camera.trigger(timeout=options.step_timeout(DEFAULT_TRIGGER_TIMEOUT))
        value = result.value
        if not isinstance(value, list) or not all(isinstance(part, Localization) for part in value):
            raise ConfigurationError(
                f"--interpret-as {options.interpret_as}: expected localizations, "
                f"got {type(value).__name__}"
            )
        return value

    def _picture_arguments(self) -> dict[str, Any]:
        """Return the arguments of a wizard that say how it gets pictures."""
        from smartcam.calibration._inside import PictureFolder

        if self.source is not None:
            return {"take_picture": self.source}
        if self.pictures is None:
            return {"take_picture": self.take_picture}
        folder = PictureFolder(self.pictures)
        return {"take_picture": folder.take, "awaited": folder.awaited}

    async def take_picture(self) -> Any:
        from smartcam.calibration._inside import decode_picture
        from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT

        # only the picture counts, not the result of the application
        options = replace(self.options, interpret_as=None)
        wait = options.step_timeout(DEFAULT_TRIGGER_TIMEOUT)
        with options.camera(str(self.url)) as unopened_camera:
            async with unopened_camera as camera:
                if not camera.capabilities.read_image:
                    raise UnsupportedError(
                        f"{camera.name}: its protocol sends no pictures; expected a protocol that "
                        "does, or --pictures FOLDER, to which the camera writes them by FTP"
                    )
                await camera.trigger(timeout=wait)
                data = await camera.read_image(timeout=wait)
                name = camera.name
        return await asyncio.to_thread(decode_picture, data, name)


def _read_lens(path: str) -> Lens:
    from smartcam.calibration._inside import read_lenses

    try:
        with label_file_errors(f"--lens {path}"):
            return read_lenses(path).lenses[0]
    except CalibrationError as exc:
        raise ConfigurationError(f"--lens: {exc}") from exc
