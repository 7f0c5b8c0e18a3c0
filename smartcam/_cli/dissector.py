"""``smartcam dissector``: the Wireshark dissector."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import async_command, label_file_errors, option

if TYPE_CHECKING:
    from smartcam._cli.options import Options


@click.command()
@option("--output", help="Write the dissector to this file instead.")
@option("--debug", help="Show tracebacks, on stderr.")
@async_command()
async def dissector(output: str | None, options: Options) -> None:
    """Print the Wireshark dissector: one Lua file for every dialect of bvs.

    Put it into Wireshark's folder for personal Lua plugins, or use it once with
    -X lua_script:FILE.
    """
    from smartcam._dissector import lua_source

    if output is None:
        click.echo(lua_source(), nl=False)
    else:
        _write(Path(output), lua_source())


def _write(path: Path, text: str) -> None:
    with label_file_errors(f"--output {path}"):
        path.write_text(text, encoding="ascii")
