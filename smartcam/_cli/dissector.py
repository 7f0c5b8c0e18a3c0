"""``smartcam dissector``: the Wireshark dissector."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import naming, option, runs
from smartcam._dissector import lua_source

if TYPE_CHECKING:
    from smartcam._cli.options import Options


@click.command()
@option("--output", help="Write it to this file instead.")
@option("--debug", help="Show tracebacks, on stderr.")
@runs()
async def dissector(output: str | None, options: Options) -> None:
    """Print the Wireshark dissector: one Lua file for every dialect of bvs.

    Put it into Wireshark's folder for personal Lua plugins, or use it once with
    -X lua_script:FILE.
    """
    if output is None:
        click.echo(lua_source(), nl=False)
    else:
        _write(Path(output))


def _write(path: Path) -> None:
    with naming(f"--output {path}"):
        path.write_text(lua_source(), encoding="ascii")
