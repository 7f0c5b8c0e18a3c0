"""``smartcam calibrate lens``: a lens from picture files, or from a source of frames."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from smartcam._cli.frame_sources import is_source, make_source
from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, label_file_errors, option
from smartcam._cli.texts import table_text
from smartcam.exceptions import CalibrationError, ConfigurationError, FrameTimeoutError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smartcam.calibration import IntrinsicCalibration, TargetView
    from smartcam.calibration._inside import Target
    from smartcam.frames import FrameSource

MAX_STILL_MOTION_PX: Final = 1.0
"""Largest motion of the points between two frames, in pixels, at which a target counts as still."""

MIN_NEW_VIEW_SHARE: Final = 0.05
"""Least motion of the points since each earlier view, as a share of the image's width."""

MAX_VIEWS: Final = 200

MAX_DESCRIPTION_BYTES: Final = 65_536
"""Largest number of bytes of a target's description."""


@dataclass(slots=True)
class ViewCollector:
    """Collects views of a target that is moved and held still in turn."""

    views: list[TargetView] = field(default_factory=list["TargetView"])
    _last: TargetView | None = None

    def add_if_new(self, view: TargetView) -> bool:
        """Add a view if the target is still and at a new place; return True if it was added."""
        last, self._last = self._last, view
        is_still = last is not None and _point_distance(last, view) <= MAX_STILL_MOTION_PX
        least_motion = MIN_NEW_VIEW_SHARE * view.size[0]
        if not is_still or any(
            _point_distance(earlier, view) < least_motion for earlier in self.views
        ):
            return False
        self.views.append(view)
        return True

    def note_target_lost(self) -> None:
        """Note that the target was not seen."""
        self._last = None


def _point_distance(first: TargetView, other: TargetView) -> float:
    """Return the root mean square distance of the points that both views have, in pixels."""
    import numpy as np

    _, index, other_index = np.intersect1d(first.ids, other.ids, return_indices=True)
    if not len(index):
        return np.inf
    distances = first.points[index] - other.points[other_index]
    return float(np.sqrt((distances**2).sum(axis=1).mean()))


def _check_output_name(_context: object, _option: object, file: str) -> str:
    if Path(file).suffix.lower() not in {".json", ".yaml", ".yml"}:
        raise click.BadParameter(f"{file}: expected a name that ends with .yaml or .json")
    return file


@click.command(
    help="Calibrate a lens from pictures of a printed target: from files, from a folder, or from a "
    "source of frames (see smartcam frames). A source's view is taken whenever the target is held "
    "still at a new place, and the next place is suggested; the command ends after "
    "--count views, or with --seconds. Pictures without the target are named and left out."
)
@click.argument("pictures", metavar="FILE...|FOLDER|URL", nargs=-1, required=True)
@click.option(
    "--target",
    metavar="FILE",
    type=click.Path(dir_okay=False),
    required=True,
    help="Description of the sheet, as smartcam sheet --describe writes it.",
)
@option(
    "--output",
    required=True,
    callback=_check_output_name,
    help="File for the lens: .yaml is a camera_info of ROS, .json also has the views, and the data "
    "that smartcam calibrate compare needs.",
)
@option("--force")
@click.option(
    "--model",
    type=click.Choice(["plumb_bob", "rational_polynomial", "equidistant"]),
    default="plumb_bob",
    show_default=True,
    help="Model of the distortion, in this order: for most lenses, wide ones, fisheyes.",
)
@click.option(
    "--sheet",
    type=click.Choice(["auto", "exact", "free"]),
    default="auto",
    show_default=True,
    help="exact: the target's points are as described; free: they are estimated with the lens; "
    "auto: the better of both at predicting views that the fit did not use.",
)
@option(
    "--count",
    type=click.IntRange(3, MAX_VIEWS),
    help="Number of views of a source.  [default: 15]",
)
@option("--seconds", help="Calibrate after this time with the views so far.")
@option("--timeout", help="Longest wait for a frame.  [default: 5]")
@async_command(*OUTPUT_OPTIONS)
async def lens(
    pictures: tuple[str, ...],
    target: str,
    output: str,
    force: bool,
    model: Any,
    sheet: Any,
    options: Options,
) -> None:
    """Calibrate a lens."""
    from smartcam.calibration import calibrate_intrinsics

    sources = [picture for picture in pictures if is_source(picture)]
    if sources and len(pictures) > 1:
        raise click.UsageError("expected files and folders, or one URL")
    if not sources and (options.count or options.seconds):
        raise click.UsageError("--count and --seconds are for a source of frames")
    _check_output_path(output, force)
    target_data = read_target(target)
    try:
        if sources:
            async with make_source(sources[0], options) as source:
                views = await _collect_views(source, target_data, options)
        else:
            views = await _find_views_in_files(pictures, target_data, options)
        calibration = await asyncio.to_thread(
            calibrate_intrinsics, views, distortion_model=model, sheet=sheet
        )
        await asyncio.to_thread(_save, output, calibration)
    except CalibrationError as exc:
        raise ConfigurationError(str(exc)) from exc
    options.show(_calibration_data(output, calibration), _calibration_text(output, calibration))


def read_target(path: str) -> Target:
    """Return the target that a file describes; ConfigurationError: a wrong file."""
    from smartcam.calibration import target_from_data

    try:
        with Path(path).open("rb") as stream:
            data: object = json.loads(stream.read(MAX_DESCRIPTION_BYTES))
    except OSError as exc:
        raise ConfigurationError(f"--target {path}: {exc.strerror}") from exc
    except (ValueError, RecursionError) as exc:
        raise ConfigurationError(f"--target {path}: not valid JSON: {exc}") from exc
    if not isinstance(data, dict):
        raise ConfigurationError(f"--target {path}: expected a file of smartcam sheet --describe")
    described: dict[str, Any] = data
    try:
        return target_from_data(described)
    except CalibrationError as exc:
        raise ConfigurationError(f"--target {path}: {exc}") from exc


def _check_output_path(file: str, force: bool) -> None:
    if Path(file).exists() and not force:
        raise ConfigurationError(f"{file}: the file exists already; --force replaces it")
    if not Path(file).parent.is_dir():
        raise ConfigurationError(f"{file}: there is no folder {Path(file).parent}")


async def _find_views_in_files(
    pictures: Sequence[str], target: Target, options: Options
) -> list[TargetView]:
    """Find the target in files; return the views of those that show it."""
    views: list[TargetView] = []
    for path in _iter_files(pictures):
        try:
            view = await asyncio.to_thread(_view_of_file, path, target)
        except CalibrationError as exc:
            _show_view(str(path), None, str(exc).removeprefix(f"{path.name}: "), options)
        else:
            views.append(view)
            _show_view(str(path), view, "", options)
    return views


def _iter_files(pictures: Sequence[str]) -> Iterator[Path]:
    """Yield the named files, and the pictures in named folders in natural order."""
    from smartcam._natural import natural
    from smartcam.calibration._inside import PICTURE_SUFFIXES

    for path in map(Path, pictures):
        if not path.is_dir():
            yield path
            continue
        inside = [file for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES]
        if not inside:
            raise ConfigurationError(
                f"{path}: expected pictures ({', '.join(sorted(PICTURE_SUFFIXES))}), found none"
            )
        yield from sorted(inside, key=lambda file: natural(file.name))


def _view_of_file(path: Path, target: Target) -> TargetView:
    from smartcam.calibration import find_target
    from smartcam.calibration._inside import MAX_PICTURE_BYTES, decode_picture

    with label_file_errors(str(path)), path.open("rb") as stream:
        data = stream.read(MAX_PICTURE_BYTES + 1)
    return find_target(decode_picture(data, path.name), target, name=path.name)


async def _collect_views(source: FrameSource, target: Target, options: Options) -> list[TargetView]:
    """Return the views collected from a source while the target is moved."""
    from smartcam.calibration import find_target
    from smartcam.calibration._inside import STANDARD_VIEWS, suggest_view

    view_count = options.count or 15
    collector, reported = ViewCollector(), set[str]()
    if not options.as_json:
        click.echo(
            f"view 1 of {view_count}: hold the target {STANDARD_VIEWS[0].text}; Ctrl-C gives up"
        )
    try:
        async with asyncio.timeout(options.seconds), source.reader() as reader:
            async for frame in reader:
                name = f"view {len(collector.views) + 1}"
                try:
                    view = await asyncio.to_thread(find_target, frame, target, name=name)
                except CalibrationError as exc:
                    collector.note_target_lost()
                    _report_once(exc, reported)
                    continue
                if not collector.add_if_new(view):
                    continue
                _show_view(f"{name} of {view_count}", view, "", options)
                if len(collector.views) == view_count:
                    break
                next_look = await asyncio.to_thread(suggest_view, collector.views, lens_known=False)
                if not options.as_json:
                    click.echo(f"  next: {next_look.text}")
    except TimeoutError as exc:
        if isinstance(exc, FrameTimeoutError):  # else --seconds are over
            raise
    return collector.views


def _report_once(error: CalibrationError, reported: set[str]) -> None:
    """Report once why a frame gives no view; raise the error if later frames cannot help."""
    from smartcam.geometry._inside import Code

    if error.code == Code.SHAPE:
        raise error
    if error.code != Code.TARGET_NOT_FOUND and error.code not in reported:
        reported.add(error.code)
        click.echo(f"note: {error}", err=True)


def _show_view(name: str, view: TargetView | None, reason: str, options: Options) -> None:
    points = 0 if view is None else len(view.ids)
    data = {"picture": name, "used": view is not None, "points": points, "reason": reason}
    text = f"not used: {reason}"
    if view is not None:
        text = "; ".join([f"{points} points", *(warning.text for warning in view.warnings)])
    options.show(data, f"{name}: {text}")


def _save(output: str, calibration: IntrinsicCalibration) -> None:
    from smartcam.calibration.formats import write_camera_info

    if Path(output).suffix.lower() == ".json":
        calibration.save(output)
    else:
        write_camera_info(output, calibration.camera)


def _calibration_data(output: str, calibration: IntrinsicCalibration) -> dict[str, Any]:
    """Return the calibration as values for JSON."""
    matrix = calibration.camera.matrix
    return {
        "file": output,
        "views": len(calibration.views),
        "held_out_px": calibration.held_out,
        "rms_px": calibration.rms,
        "lens": {
            "fx": matrix[0, 0],
            "fy": matrix[1, 1],
            "cx": matrix[0, 2],
            "cy": matrix[1, 2],
        },
        "deviations": calibration.deviations,
        "distortion": calibration.camera.distortion.tolist(),
        "lacking": list(calibration.coverage.lacking),
        "remarks": [f"{warning.code}: {warning.text}" for warning in calibration.warnings],
    }


def _calibration_text(output: str, calibration: IntrinsicCalibration) -> str:
    data = _calibration_data(output, calibration)
    rows = [
        (name, round(number, 3), round(data["deviations"].get(name, 0.0), 3))
        for name, number in data["lens"].items()
    ]
    lines = [
        f"{output}: {data['views']} views, error {data['held_out_px']:.3g} px in views left out",
        table_text(("", "pixels", "sigma"), rows),
    ]
    if data["lacking"]:
        lines.append(f"  lacking: {', '.join(_LACKING_TEXTS[kind] for kind in data['lacking'])}")
    lines += [f"  {remark}" for remark in data["remarks"]]
    return "\n".join(lines)


_LACKING_TEXTS = {
    "x": "views at the left and right",
    "y": "views above and below",
    "size": "views near and far",
    "skew": "views of a tilted target",
}
