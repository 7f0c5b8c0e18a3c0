"""``smartcam image``: write a camera's last picture to a file."""

from __future__ import annotations

from pathlib import Path

import click

from smartcam._cli.options import CAMERA_OPTIONS, CONNECT_WARNING, Options, async_command, option
from smartcam.exceptions import ConfigurationError


@click.command(
    help="Write a camera's last picture to a file, as the camera sends it (In-Sight: a bitmap), "
    "if its protocol has a request for it. A software camera is started by this command, so it "
    f"is triggered first; its picture is a PNG. {CONNECT_WARNING}"
)
@click.argument("url")
@option("--output", required=True)
@option("--force")
@async_command(*CAMERA_OPTIONS)
async def image(url: str, output: str, force: bool, options: Options) -> None:
    """Write a camera's last picture to a file."""
    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
    from smartcam.settings import is_software

    _check_output_path(output, force)
    url = await options.locate_url(url)
    with options.camera(url) as unopened_camera:
        async with unopened_camera as camera:
            if is_software(url):
                await camera.trigger(timeout=options.step_timeout(DEFAULT_TRIGGER_TIMEOUT))
            data = await camera.read_image(timeout=options.step_timeout(10.0))
            name = camera.name
    _write(output, data)
    value = {"camera": name, "file": output, "size": len(data)}
    options.show(value, f"{output}: {len(data):,} bytes")


def _check_output_path(file: str, force: bool) -> None:
    path = Path(file)
    if path.exists() and not force:
        raise ConfigurationError(f"{file}: the file exists already; --force replaces it")
    if not path.parent.is_dir():
        raise ConfigurationError(f"{file}: there is no folder {path.parent}")


def _write(file: str, data: bytes) -> None:
    try:
        Path(file).write_bytes(data)
    except OSError as exc:
        raise ConfigurationError(f"{file}: cannot be written: {exc.strerror}") from exc
