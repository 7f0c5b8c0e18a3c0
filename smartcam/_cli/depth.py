"""``smartcam depth``: clouds of points, shown and converted."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, option
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.usage import ListedGroup
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._inside import LengthUnit
    from smartcam.depth import Cloud
    from smartcam.web._inside import UpAxis

UP_AXES = ("x", "y", "z", "-x", "-y", "-z")
"""Values of ``--up``: the axis that points upwards on the page."""


def _parse_ranges(
    _ctx: click.Context, _param: click.Parameter, values: Sequence[str]
) -> list[tuple[str, float, float]]:
    """Return axis, low and high of each ``AXIS:LOW:HIGH``; an empty number means no bound."""
    ranges = []
    for value in values:
        axis, _, limits = value.partition(":")
        low, colon, high = limits.partition(":")
        try:
            bounds = (float(low or "-inf"), float(high or "inf"))
        except ValueError:
            bounds = (math.nan, math.nan)
        if axis not in ("x", "y", "z") or not colon or not bounds[0] <= bounds[1]:
            raise click.BadParameter(f"expected AXIS:LOW:HIGH, such as z:0.2:1.5, got {value!r}")
        ranges.append((axis, *bounds))
    return ranges


@click.group(
    cls=ListedGroup,
    help="Clouds of points, as .ply and .pcd files: shown on a page, filtered, converted. Needs "
    'the extra "depth".',
)
def depth() -> None:
    """Register the commands of depth."""


# ---------------------------------------------------------------------- show


_unit_option = click.option(
    "--unit",
    type=click.Choice(["m", "cm", "mm", "inch"]),
    help="Unit of the file's lengths; files that smartcam wrote contain it.",
)


@depth.command(
    help="Serve a page that shows a cloud until Ctrl-C: turn it with mouse or finger, zoom with "
    "wheel or two fingers. The page's address goes to stdout. A cloud above a million points "
    'is thinned for the page, with a note. Needs the extra "web".'
)
@click.argument("file")
@click.option(
    "--up",
    type=click.Choice(UP_AXES),
    default="z",
    show_default=True,
    help="The axis that points up; -y in the frame of a level camera.",
)
@_unit_option
@page_options(always=True)
@option("--seconds")
@async_command(*OUTPUT_OPTIONS)
async def show(
    file: str, up: UpAxis, unit: LengthUnit | None, web: PageOptions, options: Options
) -> None:
    from smartcam.depth import load_cloud
    from smartcam.web import CloudSite

    cloud = await asyncio.to_thread(load_cloud, file, unit=unit)
    async with CloudSite(cloud, up=up, **web.site_arguments) as site:
        options.show(
            {"page": site.url, "file": file, "points": len(cloud)},
            f"page: {site.url}\n  {file}: {len(cloud):,} points",
        )
        try:
            async with asyncio.timeout(options.seconds):
                await asyncio.Event().wait()
        except TimeoutError:
            pass  # --seconds are over


# ---------------------------------------------------------------------- convert


@depth.command(
    help="Write a cloud as another file, .ply or .pcd. Filters are applied in this order: "
    "ranges, outliers, then one point for each voxel."
)
@click.argument("source")
@click.argument("target")
@click.option(
    "--pass",
    "ranges",
    metavar="AXIS:LOW:HIGH",
    callback=_parse_ranges,
    multiple=True,
    help="Keep the points of a range in metres, such as z:0.2:1.5, z:0.2: or z::1.5. May be given "
    "more than once.",
)
@click.option(
    "--outliers",
    is_flag=True,
    help="Leave out the points whose mean distance to their 20 nearest neighbours is large: above "
    "that of all points by two standard deviations.",
)
@click.option(
    "--voxel",
    type=click.FloatRange(min=0, min_open=True),
    metavar="METRES",
    help="Keep one point for each cube of this size, metres.",
)
@_unit_option
@click.option("--text", is_flag=True, help="Numbers as text in place of bytes.")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@async_command(*OUTPUT_OPTIONS)
async def convert(
    source: str,
    target: str,
    ranges: Sequence[tuple[str, float, float]],
    outliers: bool,
    voxel: float | None,
    unit: LengthUnit | None,
    text: bool,
    force: bool,
    options: Options,
) -> None:
    from smartcam.depth import (
        load_cloud,
        pass_through,
        remove_statistical_outliers,
        save_cloud,
        voxel_grid,
    )

    def convert_file() -> tuple[int, Cloud]:
        if Path(target).exists() and not force:
            raise ConfigurationError(f"{target}: the file exists already; --force replaces it")
        cloud = load_cloud(source, unit=unit)
        old_count = len(cloud)
        for axis, low, high in ranges:
            cloud = pass_through(cloud, axis, low, high)
        if outliers:
            cloud = remove_statistical_outliers(cloud)
        if voxel is not None:
            cloud = voxel_grid(cloud, voxel)
        save_cloud(target, cloud, text=text)
        return old_count, cloud

    old_count, cloud = await asyncio.to_thread(convert_file)
    options.show(
        {
            "file": target,
            "points": len(cloud),
            "of": old_count,
            "colours": cloud.colours is not None,
            "sigma": cloud.sigma is not None,
        },
        f"{target}: {len(cloud):,} of {old_count:,} points",
    )
