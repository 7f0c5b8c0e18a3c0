"""``smartcam trigger``, ``watch``, ``status``, ``start``, ``stop``, ``switch``: one camera."""

from __future__ import annotations

import functools
import shlex
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import (
    CAMERA,
    CONNECTS,
    RESULTS,
    Options,
    application,
    from_hex,
    runs,
)
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.texts import application_text, not_running
from smartcam.exceptions import NotRunningError, TriggerTimeoutError, UnsupportedError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    import smartcam


@click.command(help=f"Show a camera's status; changes nothing on it. {CONNECTS}")
@click.argument("url")
@runs(*CAMERA)
async def status(url: str, options: Options) -> None:
    await _then_show(url, options)


@click.command(
    help="Trigger and print the result. Without --application nothing is started: a stopped "
    f"camera is an error (exit code 5). {CONNECTS}"
)
@click.argument("url")
@click.option("--input", "input_hex", metavar="HEX", help="Input data for each inspection, as hex.")
@runs(*RESULTS)
async def trigger(url: str, input_hex: str | None, options: Options) -> None:
    import asyncio

    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT

    as_text = options.result_text()
    data = None if input_hex is None else from_hex(input_hex, "--input")
    timeout = options.step(DEFAULT_TRIGGER_TIMEOUT)
    loop = asyncio.get_running_loop()
    url = await options.located(url)
    with options.camera(url) as unopened:
        options.remark(unopened)
        async with unopened as camera:
            end = loop.time() + options.seconds if options.seconds else None
            count = options.count or (None if end else 1)
            done = 0
            while (count is None or done < count) and (end is None or loop.time() < end):
                try:
                    result = await camera.trigger(input=data, timeout=timeout)
                except NotRunningError as exc:
                    raise not_running(exc, camera, "trigger") from exc
                options.show(result, functools.partial(as_text, camera))
                done += 1


@click.command(
    help="Print results as they come, until Ctrl-C, --count or --seconds. With --count each "
    f"result must come within --timeout. {CONNECTS}"
)
@click.argument("url")
@page_options("Show a page instead, as smartcam live does; its address goes to stdout.")
@runs(*RESULTS, interrupted=0)
async def watch(url: str, web: PageOptions, options: Options) -> None:
    if web.wanted:
        if options.count:
            raise click.UsageError("--count and --web do not go together")
        from smartcam._cli.live import serve_page

        await serve_page(url, web, options)
        return
    import asyncio

    from smartcam._cli.terminal import counting
    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
    from smartcam.settings import is_fleet

    as_text = options.result_text()
    each = options.step(DEFAULT_TRIGGER_TIMEOUT) if options.count else None
    url = await options.located(url)
    with options.camera(url) as unopened:
        # subscribed before the session begins, so the first result is seen, too
        results = unopened.results()
        async with unopened as camera:
            if not (camera.capabilities.unasked_results or is_fleet(url)):
                raise UnsupportedError(
                    f"{camera.name}: the camera sends no results by itself; to have some: "
                    f"smartcam trigger {shlex.quote(camera.url)} --count N"
                )
            done = 0
            try:
                async with counting(camera) as line, asyncio.timeout(options.seconds):
                    while options.count is None or done < options.count:
                        try:
                            async with asyncio.timeout(each):
                                result = await anext(results)
                        except TimeoutError as exc:
                            raise TriggerTimeoutError(
                                f"{camera.name}: no result within {each:g} s; "
                                f"status: {camera.status}"
                            ) from exc
                        line.clear()
                        options.show(result, functools.partial(as_text, camera))
                        done += 1
            except TriggerTimeoutError:
                raise
            except TimeoutError:  # --seconds are over
                if not done and not options.as_json:
                    click.echo(
                        f"note: no result came in {options.seconds:g} s; status: {camera.status}",
                        err=True,
                    )


@click.command(
    help="Load another application by its id, or by its file's name if the camera can do that; "
    f"returns when the camera is ready. It runs if the previous one ran. {CONNECTS}"
)
@click.argument("url")
@click.argument("id_or_file", metavar="ID|FILE", type=application)
@runs(*CAMERA)
async def switch(url: str, id_or_file: int | str, options: Options) -> None:
    try:
        await _then_show(url, options, lambda camera: camera.switch_application(id_or_file))
    except UnsupportedError as exc:
        if isinstance(id_or_file, int):
            raise
        raise UnsupportedError(
            f"{id_or_file!r:.80} is no id, and so the name of a file: {exc}"
        ) from exc


@click.command(help=f"Enter run mode; returns when the camera is ready. {CONNECTS}")
@click.argument("url")
@runs(*CAMERA)
async def start(url: str, options: Options) -> None:
    await _then_show(url, options, lambda camera: camera.start(timeout=options.step(10.0)))


@click.command(help=f"Leave run mode; returns when the camera has stopped. {CONNECTS}")
@click.argument("url")
@runs(*CAMERA)
async def stop(url: str, options: Options) -> None:
    await _then_show(url, options, lambda camera: camera.stop(timeout=options.step(10.0)))


async def _then_show(
    url: str,
    options: Options,
    action: Callable[[smartcam.Camera], Awaitable[None]] | None = None,
) -> None:
    """Connect, run an action, and show the camera's state afterwards."""
    url = await options.located(url)
    with options.camera(url) as unopened:
        async with unopened as camera:
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
