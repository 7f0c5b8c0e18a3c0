"""``smartcam demo``: choose the demonstration."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command
from smartcam._extras import from_part

if TYPE_CHECKING:
    _ParamType = click.ParamType[tuple[int, int, int]]
else:  # click before 8.4 has no types of values there
    _ParamType = click.ParamType


class PalletSize(_ParamType):
    """The size of a pallet: ``ROWSxCOLUMNSxLAYERS``."""

    name = "ROWSxCOLUMNSxLAYERS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int, int]:
        """Return rows, columns and layers."""
        match = re.fullmatch(r"(\d{1,3})x(\d{1,3})x(\d{1,3})", str(value))
        rows, columns, layers = map(int, match.groups()) if match else (0, 0, 0)
        if not (2 <= rows <= 12 and 2 <= columns <= 12 and 1 <= layers <= 10):
            self.fail(f"expected {self.name} from 2x2x1 to 12x12x10, got {value!r}", param, ctx)
        return rows, columns, layers


@click.command()
@click.option(
    "--pick",
    is_flag=True,
    help="Calibrate a simulated robot against the camera instead, and pick seven parts with it.",
)
@click.option(
    "--plain",
    is_flag=True,
    help="With --pick: locate a taught part in synthetic pictures of a camera that is not smart, "
    'and put the parts onto a pallet. Needs the extra "inspection".',
)
@click.option(
    "--pallet",
    type=PalletSize(),
    default="2x3x2",
    show_default=True,
    help="With --plain: rows, columns and layers of the pallet, 2x2x1 to 12x12x10.",
)
@click.option(
    "--fleet",
    "use_fleet",
    is_flag=True,
    help="Have two agents share ten cameras, and three programs use one of these, instead. Needs "
    'the extra "fleet".',
)
@click.option(
    "--tower",
    is_flag=True,
    help="Build a tower of black blocks by a simulated robot with a camera at its hand, "
    'instead. Needs the extra "depth".',
)
@click.option(
    "--inspect",
    "use_inspection",
    is_flag=True,
    help="Read, check and compare synthetic parts by a software camera, instead; draw its "
    'findings. Needs the extra "inspection".',
)
@click.option(
    "--folder",
    type=click.Path(file_okay=False),
    help="With --inspect and --plain: folder for pictures, cell file and models.  [default: "
    "demo-inspect, demo-pick]",
)
@click.option(
    "--picture",
    type=click.Path(dir_okay=False),
    default="pick.svg",
    show_default=True,
    help="With --pick alone: file for the picture of the calibration (SVG).",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="With --pick, --tower and --inspect: seed of all noise and places.",
)
@async_command(*OUTPUT_OPTIONS)
async def demo(
    pick: bool,
    plain: bool,
    pallet: tuple[int, int, int],
    use_fleet: bool,
    tower: bool,
    use_inspection: bool,
    folder: str | None,
    picture: str,
    seed: int,
    options: Options,
) -> None:
    """Show smartcam's main job with an emulated camera over real TCP."""
    flags = {"--pick": pick, "--fleet": use_fleet, "--tower": tower, "--inspect": use_inspection}
    chosen = [name for name, is_chosen in flags.items() if is_chosen]
    if len(chosen) > 1:
        raise click.UsageError(f"{' and '.join(chosen)} do not go together")
    if plain and not pick:
        raise click.UsageError("--plain goes with --pick")
    if use_inspection:
        with from_part("inspection", "smartcam demo --inspect needs"):
            from smartcam._cli import demo_inspect

        await demo_inspect.inspect(options, Path(folder or "demo-inspect"), seed)
    elif tower:
        with from_part("depth", "smartcam demo --tower needs"):
            from smartcam._cli import demo_tower

        await demo_tower.tower(options, seed)
    elif use_fleet:
        with from_part("fleet", "smartcam demo --fleet needs"):
            from smartcam._cli import demo_fleet

        await demo_fleet.demo(options)
    elif plain:
        with from_part("inspection", "smartcam demo --plain needs"):
            from smartcam._cli import demo_pallet

        grid = demo_pallet.Grid(*pallet)
        await demo_pallet.palletize(options, Path(folder or "demo-pick"), seed, grid)
    elif pick:
        with from_part("calibration", "smartcam demo --pick needs"):
            from smartcam._cli import demo_pick

        await demo_pick.pick(options, picture, seed)
    else:
        from smartcam._cli import demo as demo_steps

        await demo_steps.demo(options)
