"""``smartcam teach``: an application of a software camera, made and tried on pictures."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from smartcam._cli.inspect import picture_files
from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, option
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import run_until_first
from smartcam._cli.texts import value_text
from smartcam._extras import from_part
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.frames import FrameSource
    from smartcam.inspection import Inspection
    from smartcam.inspection._inside import Teaching
    from smartcam.web._inside import TeachSite

LINGER_TIME: Final = 3.0
"""Seconds for which the device continues streaming after a picture."""


@click.command(
    help="Teach an application of a software camera, on a page or by options: draw regions, "
    "choose tools, see what they find, set tolerances, save. CELL is a cell file, or a fleet file "
    "with software cameras; APPLICATION is its number or name, a new number is added. The page "
    "tries the tools at once on all PICTURES (files, or folders of them; without any, the camera's "
    "own), and sets tolerances from those that show good parts. Save writes the file; its comments "
    "stay. The page's address goes to stdout. With --set, --learn or --save there is no page: the "
    "tools are changed, tried on the PICTURES, and printed. The page needs the extra "
    '"web".'
)
@click.argument("cell")
@click.argument("camera")
@click.argument("application_name", metavar="APPLICATION")
@click.argument("pictures", nargs=-1)
@click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="TOOL.SETTING=VALUE",
    help="Change a setting, such as 'present.region=[10, 10, 80, 60]'. VALUE is YAML; an "
    "empty VALUE removes the setting. A tool that the application lacks is added. Repeatable.",
)
@click.option(
    "--learn",
    is_flag=True,
    help="Set tolerances from the PICTURES, which show good parts, and print the reasons.",
)
@click.option("--save", is_flag=True, help="Write the file.")
@page_options(always=True)
@option("--seconds")
@async_command(*OUTPUT_OPTIONS)
async def teach(
    cell: str,
    camera: str,
    application_name: str,
    pictures: Sequence[str],
    changes: Sequence[str],
    learn: bool,
    save: bool,
    web: PageOptions,
    options: Options,
) -> None:
    """Serve the page, or change the tools by the options."""
    with from_part("inspection", "smartcam teach needs"):
        from smartcam.inspection._inside import Teaching

    teaching = Teaching(cell, camera, application_name)
    files = [file for picture in pictures for file in picture_files(Path(picture))]
    if changes or learn or save:
        await asyncio.to_thread(_change_tools, teaching, files, changes, learn, save, options)
        return
    from smartcam.web._inside import TeachSite

    async with contextlib.AsyncExitStack() as stack:
        source: FrameSource | None = None
        if not files:
            from smartcam import frames

            source = await stack.enter_async_context(
                frames.open(teaching.frames, linger=LINGER_TIME)
            )
        site = TeachSite(teaching, files, source=source, **web.site_arguments)
        await run_until_first([_serve(site, options)], options.seconds)


async def _serve(site: TeachSite, options: Options) -> None:
    async with site:
        options.show({"page": site.url}, f"page: {site.url}")
        await asyncio.Event().wait()


def _change_tools(
    teaching: Teaching,
    files: Sequence[Path],
    changes: Sequence[str],
    learn: bool,
    save: bool,
    options: Options,
) -> None:
    """Change the tools, try them on the pictures, and save them if ``save``."""
    from smartcam.inspection import Picture
    from smartcam.inspection._inside import learn_tolerances

    tools = _apply_changes(teaching.tools, changes)
    program = teaching.program(tools)
    pictures = [(file, Picture.read(file)) for file in files]
    remarks: list[str] = []
    if learn:
        if not pictures:
            raise click.UsageError("--learn: expected PICTURES of good parts, got none")
        inspections = {str(file): program.inspect(picture) for file, picture in pictures}
        tools, remarks = learn_tolerances(tools, inspections)
        program = teaching.program(tools)
    for file, picture in pictures:
        _show_inspection(str(file), program.inspect(picture), options)
    if save:
        teaching.save(tools)
    value = {"application": teaching.application, "tools": tools, "saved": save}
    if learn:
        value["learned"] = remarks
    text = [f"{'saved' if save else 'not saved'}: application {teaching.application}"]
    text += [f"  {key}: {settings}" for key, settings in tools.items()]
    text += [f"learned {remark}" for remark in remarks]
    options.show(value, "\n".join(text))


def _show_inspection(file: str, inspection: Inspection, options: Options) -> None:
    from smartcam.layout._inside import ShownUnits

    verdict = "ok" if inspection.ok else f"not ok: {inspection.reason}"
    value: dict[str, Any] = {"file": file, "ok": inspection.ok, "reason": inspection.reason}
    value["value"] = inspection.value
    text = value_text(inspection.value, ShownUnits([]), inspection.layout)
    options.show(value, f"{file}: {verdict}\n{text}")


def _apply_changes(
    tools: dict[str, dict[str, Any]], changes: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Change settings of the tools in place, and return the tools.

    Raises ConfigurationError: a change is not valid.
    """
    from smartcam.layout._inside import BadYamlError, load

    for change in changes:
        setting_path, equals, text = change.partition("=")
        key, dot, name = setting_path.strip().rpartition(".")
        if not (equals and dot and key and name):
            raise ConfigurationError(f"--set: expected TOOL.SETTING=VALUE, got {change!r:.100}")
        settings = tools.setdefault(key, {})
        if not text.strip():
            settings.pop(name, None)
            continue
        try:
            settings[name] = load(text, label=f"--set {setting_path}")
        except BadYamlError as exc:
            raise ConfigurationError(f"--set {setting_path}: {exc}") from exc
    return tools
