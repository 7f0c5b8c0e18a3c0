"""``smartcam trigger``, ``watch``, ``status``, ``start``, ``stop``, ``switch``: one camera."""

from __future__ import annotations

import functools
import shlex
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import (
    CAMERA_OPTIONS,
    CONNECT_WARNING,
    RESULT_OPTIONS,
    Options,
    async_command,
    from_hex,
    parse_application,
)
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.texts import application_text, not_running_error
from smartcam.exceptions import NotRunningError, TriggerTimeoutError, UnsupportedError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    import smartcam


@click.command(help=f"Show a camera's status; changes nothing on it. {CONNECT_WARNING}")
@click.argument("url")
@async_command(*CAMERA_OPTIONS)
async def status(url: str, options: Options) -> None:
    await _run_and_show(url, options)


@click.command(
    help="Trigger and print the result. Without --application nothing is started: a stopped "
    f"camera is an error (exit code 5). {CONNECT_WARNING}"
)
@click.argument("url")
@click.option("--input", "input_hex", metavar="HEX", help="Input data for each inspection, as hex.")
@async_command(*RESULT_OPTIONS)
async def trigger(url: str, input_hex: str | None, options: Options) -> None:
    import asyncio

    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT

    make_text = options.result_text()
    data = None if input_hex is None else from_hex(input_hex, "--input")
    timeout = options.step_timeout(DEFAULT_TRIGGER_TIMEOUT)
    loop = asyncio.get_running_loop()
    url = await options.locate_url(url)
    with options.camera(url) as unopened_camera:
        options.show_remarks(unopened_camera)
        async with unopened_camera as camera:
            end = loop.time() + options.seconds if options.seconds else None
            count = options.count or (None if end else 1)
            result_count = 0
            while (count is None or result_count < count) and (end is None or loop.time() < end):
                try:
                    result = await camera.trigger(input=data, timeout=timeout)
                except NotRunningError as exc:
                    raise not_running_error(exc, camera, "trigger") from exc
                options.show(result, functools.partial(make_text, camera))
                result_count += 1


@click.command(
    help="Print results as they come, until Ctrl-C, --count or --seconds. With --count each "
    f"result must come within --timeout. {CONNECT_WARNING}"
)
@click.argument("url")
@page_options("Show a page instead, as smartcam live does; its address goes to stdout.")
@async_command(*RESULT_OPTIONS, interrupt_code=0)
async def watch(url: str, web: PageOptions, options: Options) -> None:
    if web.is_wanted:
        if options.count:
            raise click.UsageError("--count and --web do not go together")
        from smartcam._cli.live import serve_page

        await serve_page(url, web, options)
        return
    import asyncio

    from smartcam._cli.terminal import counting_line
    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
    from smartcam.settings import is_fleet

    make_text = options.result_text()
    result_timeout = options.step_timeout(DEFAULT_TRIGGER_TIMEOUT) if options.count else None
    url = await options.locate_url(url)
    with options.camera(url) as unopened_camera:
        # subscribe before the session begins, so that the first result is not missed
        results = unopened_camera.results()
        async with unopened_camera as camera:
            if not (camera.capabilities.unasked_results or is_fleet(url)):
                raise UnsupportedError(
                    f"{camera.name}: the camera sends no results by itself; to have some: "
                    f"smartcam trigger {shlex.quote(camera.url)} --count N"
                )
            result_count = 0
            try:
                async with counting_line(camera) as line, asyncio.timeout(options.seconds):
                    while options.count is None or result_count < options.count:
                        try:
                            async with asyncio.timeout(result_timeout):
                                result = await anext(results)
                        except TimeoutError as exc:
                            raise TriggerTimeoutError(
                                f"{camera.name}: no result within {result_timeout:g} s; "
                                f"status: {camera.status}"
                            ) from exc
                        line.clear()
                        options.show(result, functools.partial(make_text, camera))
                        result_count += 1
            except TriggerTimeoutError:
                raise
            except TimeoutError:  # --seconds are over
                if not result_count and not options.as_json:
                    click.echo(
                        f"note: no result came in {options.seconds:g} s; status: {camera.status}",
                        err=True,
                    )


@click.command(
    help="Load another application by its id, or by its file's name if the camera can do that; "
    f"returns when the camera is ready. It runs if the previous one ran. {CONNECT_WARNING}"
)
@click.argument("url")
@click.argument("id_or_file", metavar="ID|FILE", type=parse_application)
@async_command(*CAMERA_OPTIONS)
async def switch(url: str, id_or_file: int | str, options: Options) -> None:
    try:
        await _run_and_show(url, options, lambda camera: camera.switch_application(id_or_file))
    except UnsupportedError as exc:
        if isinstance(id_or_file, int):
            raise
        raise UnsupportedError(
            f"{id_or_file!r:.80} is no id, and so the name of a file: {exc}"
        ) from exc


@click.command(help=f"Enter run mode; returns when the camera is ready. {CONNECT_WARNING}")
@click.argument("url")
@async_command(*CAMERA_OPTIONS)
async def start(url: str, options: Options) -> None:
    await _run_and_show(
        url, options, lambda camera: camera.start(timeout=options.step_timeout(10.0))
    )


@click.command(help=f"Leave run mode; returns when the camera has stopped. {CONNECT_WARNING}")
@click.argument("url")
@async_command(*CAMERA_OPTIONS)
async def stop(url: str, options: Options) -> None:
    await _run_and_show(
        url, options, lambda camera: camera.stop(timeout=options.step_timeout(10.0))
    )


async def _run_and_show(
    url: str,
    options: Options,
    action: Callable[[smartcam.Camera], Awaitable[None]] | None = None,
) -> None:
    """Connect, run an action, and show the camera's state after it."""
    url = await options.locate_url(url)
    with options.camera(url) as unopened_camera:
        async with unopened_camera as camera:
            if action is not None:
                await action(camera)
            _show_camera(camera, options)


def _show_camera(camera: smartcam.Camera, options: Options) -> None:
    from smartcam.models import Status

    value = {
        "camera": camera.name,
        "url": camera.url,
        "status": camera.status,
        "active_application": camera.active_application,
        "protocol_version": camera.protocol_version,
    }
    running = "running" if Status.RUNNING in camera.status else "stopped"
    active = application_text(camera.active_application)
    options.show(
        value,
        f"{camera.url}\n  {active}, {running}\n"
        f"  status: {camera.status}\n  protocol version {camera.protocol_version}",
    )
