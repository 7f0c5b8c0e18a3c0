"""``smartcam calibrate compare`` and ``draw``: commands on calibrations in files."""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, label_file_errors
from smartcam._cli.texts import table_text
from smartcam._cli.usage import ListedGroup, write_commands
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._inside import LengthUnit, LensComparison, MapFigures, StoredLenses

DIFFERENT_EXIT_CODE = 7
"""Exit code after a comparison of calibrations that differ by more than noise explains."""

COLUMNS = ("centre", "corners", "worst", "rms")
"""Columns of the table of differences between two calibrations, pixels."""


WIZARDS = ("plane", "sheet", "hand-eye")
"""The values of --wizard."""

MIN_LIKENESS = 0.75
"""Least similarity to a command, 0 to 1, at which a word is taken for that command and not for a
host."""

DEFAULT_COMMAND = "wizard"
"""Name of the default command of ``calibrate``, which users need not type."""


class DefaultCommandContext(click.Context):
    """The context of a group's default command; usage texts show only the group's name."""

    @property
    def command_path(self) -> str:
        """The command's path without the name of the default command."""
        return super().command_path.rstrip()


class DefaultCommand(click.Command):
    """The default command; its help also lists the other commands."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, and the commands."""
        super().format_options(ctx, formatter)
        if ctx.parent is not None and isinstance(ctx.parent.command, click.Group):
            write_commands(ctx.parent.command, ctx, formatter)


class GroupWithDefault(ListedGroup):
    """A group of commands; arguments without a command go to the default command."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse; insert the default command if the first word is no command."""
        has_no_command = not args or args[0] not in self.commands
        if has_no_command and args and re.fullmatch(r"[A-Za-z][\w-]*", args[0]):
            self._check_host(ctx, *args[:2])
        return super().parse_args(ctx, [DEFAULT_COMMAND, *args] if has_no_command else args)

    def _check_host(self, ctx: click.Context, word: str, next_word: str = "-") -> None:
        """Fail for a word that is probably a command or a wizard, and not a host."""
        from smartcam._suggestions import closest, did_you_mean

        if word in WIZARDS:
            ctx.fail(f"{word!r} is no command but a wizard: smartcam calibrate URL --wizard {word}")
        commands = [name for name in self.list_commands(ctx) if name != DEFAULT_COMMAND]
        if (
            next_word.startswith("-")
            and closest(word, [*commands, *WIZARDS], least=MIN_LIKENESS) is None
        ):
            return
        hint = did_you_mean(word, commands) or f"; commands are {', '.join(commands)}"
        ctx.fail(
            f"No such command {word!r}{hint}; a wizard is named by --wizard, one of "
            f"{', '.join(WIZARDS)}; a host of that name is bvs://{word}"
        )

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command and its arguments; the default command has no name."""
        name, command, arguments = super().resolve_command(ctx, args)
        return (None if name == DEFAULT_COMMAND else name), command, arguments


def _check_svg_name(_context: object, _option: object, path: str | None) -> str | None:
    if path is not None and Path(path).suffix.lower() != ".svg":
        raise click.BadParameter(f"{path}: expected a name that ends with .svg")
    return path


def distance_option(function: Any) -> Any:
    """Declare --distance."""
    return click.option(
        "--distance",
        type=click.FloatRange(min=0, min_open=True, max=1e6),
        metavar="M",
        help="Distance of the points from the camera, metres.  [default: infinity]",
    )(function)


@click.command(
    help="Compare two calibrations of one lens, or of one pair: the difference of their "
    "projections, after the small motion of the camera that cancels most of it, beside the effect "
    "of noise. A and B are calibrations of smartcam (lens, pair, camera on a robot), "
    "camera_info of ROS, camchains of Kalibr, files of OpenCV or of others whose format is known; "
    "the effect of noise is only known for calibrations of a lens. "
    f"Exit code {DIFFERENT_EXIT_CODE} if they differ by more than noise explains; 0 otherwise, "
    "also without a verdict."
)
@click.argument("a", type=click.Path(dir_okay=False))
@click.argument("b", type=click.Path(dir_okay=False))
@distance_option
@click.option(
    "--unit",
    type=click.Choice(["m", "cm", "mm", "inch"]),
    help="Unit of lengths between cameras, for files without one, such as OpenCV's.",
)
@click.option(
    "--svg",
    metavar="FILE",
    type=click.Path(dir_okay=False),
    callback=_check_svg_name,
    help="Draw the differences there, beside what noise leads to; of a pair two files, -left and "
    "-right.",
)
@async_command(*OUTPUT_OPTIONS)
async def compare(
    a: str,
    b: str,
    distance: float | None,
    unit: LengthUnit | None,
    svg: str | None,
    options: Options,
) -> None:
    """Compare two calibrations."""
    from smartcam.calibration._inside import compare_estimates, rig_difference

    first, second = _read(a, unit), _read(b, unit)
    if len(first.lenses) != len(second.lenses):
        raise ConfigurationError(
            f"{a} and {b}: expected as many cameras in both, got {len(first.lenses)} and "
            f"{len(second.lenses)}"
        )
    comparisons = [
        compare_estimates(lens, other, distance=distance)
        for lens, other in zip(first.lenses, second.lenses, strict=True)
    ]
    for name, comparison in zip(first.names, comparisons, strict=True):
        options.show(_comparison_data(name, comparison), _comparison_text(name, comparison))
    pairs = itertools.pairwise(comparisons)
    for transform, other, pair in zip(first.transforms, second.transforms, pairs, strict=True):
        turn, shift = rig_difference(transform, other, *pair)
        between = f"{transform.target} to {transform.source}"
        value = {"between": between, "turn_deg": math.degrees(turn), "shift_mm": 1e3 * shift}
        text = f"{between}: {math.degrees(turn):.4f} degrees and {1e3 * shift:.3f} mm apart"
        options.show(value, text)
    if svg is not None:
        _draw_comparisons(svg, first.names, comparisons, f"{a} and {b}")
    if any(comparison.same is False for comparison in comparisons):
        raise SystemExit(DIFFERENT_EXIT_CODE)


@click.command(
    help="Draw the calibration in a file as SVG: the errors of its views as bars (views), targets "
    "and cameras in space (scene), a lens' uncertainty over its field (uncertainty), a "
    "plane with its touches (plane)."
)
@click.argument("file", type=click.Path(dir_okay=False))
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    type=click.Path(dir_okay=False),
    required=True,
    callback=_check_svg_name,
    help="File for the picture; .svg.",
)
@click.option(
    "--what",
    "drawing",
    type=click.Choice(["views", "scene", "uncertainty", "plane"]),
    help="What to draw.  [default: views; of a plane the plane]",
)
@distance_option
@async_command(*OUTPUT_OPTIONS)
async def draw(
    file: str, output: str, drawing: Any, distance: float | None, options: Options
) -> None:
    """Draw a calibration."""
    from smartcam.calibration._inside import draw_file

    with label_file_errors(file):
        svg_text = draw_file(file, drawing, distance)
    _write(output, svg_text)
    options.show({"file": output}, output)


def _read(path: str, unit: LengthUnit | None) -> StoredLenses:
    from smartcam.calibration._inside import read_lenses

    with label_file_errors(path):
        return read_lenses(path, unit=unit)


def _comparison_data(name: str, comparison: LensComparison) -> dict[str, Any]:
    turn, shift = _camera_motion(comparison)
    return {
        "camera": name,
        "same": comparison.same,
        "ratio": comparison.ratio,
        "chance": comparison.chance,
        "distance_m": comparison.distance,
        "difference_px": _figures_data(comparison.observed),
        "predicted_px": None
        if comparison.predicted is None
        else _figures_data(comparison.predicted),
        "turn_deg": turn,
        "shift_mm": shift,
    }


def _comparison_text(name: str, comparison: LensComparison) -> str:
    rows = [_figures_row("difference", comparison.observed)]
    if comparison.predicted is not None:
        rows.append(_figures_row("from noise", comparison.predicted))
    turn, shift = _camera_motion(comparison)
    where = "at infinity" if comparison.distance is None else f"at {comparison.distance:g} m"
    return "\n".join(
        [
            f"{name}: {comparison.verdict}",
            table_text(("", *COLUMNS), rows),
            f"  pixels, of a coordinate, {where}; after a turn of {turn:.3g} degrees and a shift "
            f"of {shift:.3g} mm",
        ]
    )


def _figures_data(figures: MapFigures) -> dict[str, float | None]:
    """Return the figures for JSON, with None for NaN."""
    values = figures._asdict().items()
    return {name: value if math.isfinite(value) else None for name, value in values}


def _figures_row(name: str, figures: MapFigures) -> list[object]:
    return [
        name,
        *(round(float(f"{figure:.3g}"), 6) if math.isfinite(figure) else "-" for figure in figures),
    ]


def _camera_motion(comparison: LensComparison) -> tuple[float, float]:
    cosine = (float(comparison.motion.rotation.trace()) - 1.0) / 2.0
    turn = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    return turn, 1e3 * math.hypot(*comparison.motion.translation)


def _draw_comparisons(
    path: str, names: Sequence[str], comparisons: Sequence[LensComparison], title: str
) -> None:
    from smartcam.calibration import draw_uncertainty

    for name, comparison in zip(names, comparisons, strict=True):
        file = Path(path)
        if len(comparisons) > 1:
            file = file.with_stem(f"{file.stem}-{name}")
        _write(str(file), draw_uncertainty(comparison, title=f"{title}: {name}"))


def _write(path: str, svg: str) -> None:
    with label_file_errors(path):
        Path(path).write_text(svg, encoding="utf-8", newline="\n")
