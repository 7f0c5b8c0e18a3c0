"""Pictures made small: bytes a frame at the same PSNR, and the CPU time of both ends.

Colour and 16-bit depth of :mod:`benchmarks.scenes`, 640 x 480 at 30 a second, half of it standing
still. What loses something is set so that the PSNR of the brightness, over all frames, is what the
line says; what loses nothing is what it is. The yardstick is the raw picture. Encoding and decoding
are CPU time of the process with all its threads.
"""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.measure import Comparison, Series
from benchmarks.scenes import SIZE, colour_scene, depth_scene
from smartcam import frames

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from numpy.typing import NDArray

    from benchmarks.measure import Plan
    from smartcam.frames import Frame

__all__ = ["run"]

FRAMES = 40
RATE = 30.0
DECIBELS = (36.0, 40.0)
BRIGHTNESS = np.array([0.299, 0.587, 0.114], np.float32)
"""Parts of the three colours (ITU-R BT.601)."""

TRIES = 6
"""Of settings, each half as far from the last one."""


@dataclass(frozen=True, slots=True)
class Coded:
    """What became of some frames.

    Attributes:
        size: bytes of a frame, in the mean.
        encoding: milliseconds of CPU time a frame.
        decoding: the same, of the way back.
        psnr: decibels, of the brightness over all of them; ``inf``: nothing is lost.
    """

    size: float
    encoding: float
    decoding: float
    psnr: float


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure sizes, and what they cost."""
    count = plan.operations(FRAMES, least=4)
    yield from asyncio.run(_run(count))


async def _run(count: int) -> list[Comparison]:
    colours = [_frame(one, "RGB8", number) for number, one in enumerate(colour_scene(count))]
    depths = [_frame(one, "Coord3D_C16", number) for number, one in enumerate(depth_scene(count))]
    found: list[Comparison] = []
    async with frames.Codecs(threads=1) as codecs:
        for what, pictures in (("colour", colours), ("16-bit depth", depths)):
            raw = float(len(pictures[0].data))
            for name, encode in (("PNG", codecs.png), ("JPEG XL", codecs.jpegxl)):
                coded = await _each(codecs, pictures, encode)
                found.append(_line(f"{what}, {name} without loss", coded, raw))
        raw = float(len(colours[0].data))
        for decibels in DECIBELS:
            for name, code, worst, best in (
                ("JPEG", _jpeg, 1.0, 100.0),
                ("H.264", _h264, 51.0, 0.0),
            ):
                setting, coded = await _at(decibels, codecs, colours, code, worst, best)
                title = f"colour at {decibels:g} dB, {name} ({setting})"
                found.append(_line(title, coded, raw))
    return found


def _line(case: str, coded: Coded, raw: float) -> Comparison:
    rate = coded.size * 8 * RATE / 1e6
    loss = "nothing lost" if math.isinf(coded.psnr) else f"{coded.psnr:.1f} dB"
    return Comparison(
        "pictures",
        case,
        Series("smartcam", "kB", [coded.size / 1e3]),
        Series("raw", "kB", [raw / 1e3]),
        note=f"{rate:.2f} Mbit/s at {RATE:g} a second, {loss}, encoding {coded.encoding:.1f} ms, "
        f"decoding {coded.decoding:.1f} ms",
    )


def _frame(pixels: NDArray[np.uint8] | NDArray[np.uint16], name: str, number: int) -> Frame:
    now = time.monotonic()
    return frames.Frame(
        data=pixels.tobytes(),
        format=frames.find_format(name),
        width=SIZE[0],
        height=SIZE[1],
        stride=pixels.strides[0],
        captured=now,
        utc=time.time(),
        moment=frames.Moment.EXPOSURE_START,
        sequence=number,
        source="scene",
    )


async def _at(
    decibels: float,
    codecs: frames.Codecs,
    pictures: list[Frame],
    code: Callable[[frames.Codecs, list[Frame], float], Awaitable[tuple[str, Coded]]],
    worst: float,
    best: float,
) -> tuple[str, Coded]:
    """Return the cheapest setting that reaches a PSNR, and what it gives."""
    found = await code(codecs, pictures, best)
    for _ in range(TRIES):
        middle = (worst + best) / 2
        tried = await code(codecs, pictures, middle)
        if tried[1].psnr >= decibels:
            best, found = middle, tried
        else:
            worst = middle
    return found


async def _jpeg(codecs: frames.Codecs, pictures: list[Frame], setting: float) -> tuple[str, Coded]:
    quality = round(setting)
    coded = await _each(codecs, pictures, lambda one: codecs.jpeg(one, quality=quality))
    return f"q{quality}", coded


async def _h264(codecs: frames.Codecs, pictures: list[Frame], setting: float) -> tuple[str, Coded]:
    crf = round(setting, 1)
    encoder = codecs.h264_encoder(fps=RATE, crf=crf)
    decoder = codecs.h264_decoder()
    coded = await _through(codecs, pictures, encoder.encode, decoder.decode)
    return f"crf {crf:g}", coded


async def _each(
    codecs: frames.Codecs, pictures: list[Frame], encode: Callable[[Frame], Awaitable[Frame]]
) -> Coded:
    name = pictures[0].format.name
    return await _through(codecs, pictures, encode, lambda one: codecs.decode(one, name))


async def _through(
    codecs: frames.Codecs,
    pictures: list[Frame],
    encode: Callable[[Frame], Awaitable[Frame]],
    decode: Callable[[Frame], Awaitable[Frame | None]],
) -> Coded:
    begin = time.process_time()
    made = [await encode(one) for one in pictures]
    between = time.process_time()
    back = [await decode(one) for one in made]
    end = time.process_time()
    pairs = zip(pictures, back, strict=True)
    square = float(np.mean([await _square(codecs, *pair) for pair in pairs]))
    return Coded(
        size=sum(len(one.data) for one in made) / len(made),
        encoding=(between - begin) / len(made) * 1e3,
        decoding=(end - between) / len(made) * 1e3,
        psnr=math.inf if square == 0 else 10 * math.log10(255**2 / square),
    )


async def _square(codecs: frames.Codecs, sent: Frame, came: Frame | None) -> float:
    if came is None:
        raise RuntimeError(f"frame {sent.sequence} did not come back")
    if came.format.name not in {"RGB8", sent.format.name}:
        came = await codecs.converted(came, "RGB8")
    difference = sent.array().astype(np.float32) - came.array()
    brightness = difference @ BRIGHTNESS if difference.ndim == 3 else difference
    return float(np.mean(brightness**2))
