"""``smartcam demo``: which of the demonstrations is meant."""

from __future__ import annotations

from pathlib import Path

import click

from smartcam._cli.options import OUTPUT, Options, runs
from smartcam._extras import from_part


@click.command()
@click.option(
    "--pick",
    is_flag=True,
    help="Calibrate a simulated robot against the camera instead, and pick seven parts with it.",
)
@click.option(
    "--fleet",
    "shared",
    is_flag=True,
    help="Have two agents share ten cameras, and three programs one of them, instead. Needs the "
    'extra "fleet".',
)
@click.option(
    "--tower",
    is_flag=True,
    help="Have a simulated robot with a camera at its hand build a tower of the black blocks that "
    'it finds, instead. Needs the extra "depth".',
)
@click.option(
    "--inspect",
    "inspected",
    is_flag=True,
    help="Have a software camera read, check and compare drawn parts, instead, and draw what it "
    'saw. Needs the extra "inspection".',
)
@click.option(
    "--folder",
    type=click.Path(file_okay=False),
    default="demo-inspect",
    show_default=True,
    help="With --inspect: where the pictures and the cell file go.",
)
@click.option(
    "--picture",
    type=click.Path(dir_okay=False),
    default="pick.svg",
    show_default=True,
    help="With --pick: where the picture of the calibration goes (SVG).",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="With --pick, --tower and --inspect: of all noise, and of where things are.",
)
@runs(*OUTPUT)
async def demo(
    pick: bool,
    shared: bool,
    tower: bool,
    inspected: bool,
    folder: str,
    picture: str,
    seed: int,
    options: Options,
) -> None:
    """Watch smartcam do its main job against an emulated camera over real TCP."""
    asked = {"--pick": pick, "--fleet": shared, "--tower": tower, "--inspect": inspected}
    given = [name for name, wanted in asked.items() if wanted]
    if len(given) > 1:
        raise click.UsageError(f"{' and '.join(given)} do not go together")
    if inspected:
        with from_part("inspection", "smartcam demo --inspect needs"):
            from smartcam._cli import demo_inspect

        await demo_inspect.inspect(options, Path(folder), seed)
    elif tower:
        with from_part("depth", "smartcam demo --tower needs"):
            from smartcam._cli import demo_tower

        await demo_tower.tower(options, seed)
    elif shared:
        with from_part("fleet", "smartcam demo --fleet needs"):
            from smartcam._cli import demo_fleet

        await demo_fleet.demo(options)
    elif pick:
        with from_part("calibration", "smartcam demo --pick needs"):
            from smartcam._cli import demo_pick

        await demo_pick.pick(options, picture, seed)
    else:
        from smartcam._cli import demo as demo_steps

        await demo_steps.demo(options)
