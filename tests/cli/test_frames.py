"""``smartcam frames``: list, grab, show, measure."""

from __future__ import annotations

import asyncio
import dataclasses
import io
import json
import re
import signal
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam._cli.frame_measure import measure
from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames import FoundSource, Frame, FrameSink, Moment, StreamFormat, find_format
from smartcam.frames import open as open_frames
from smartcam.registry import FRAMES
from tests.cli.commandline import run
from tests.frames.drivers import ShowingDriver
from tests.frames.pictures import stripes, write_stamp
from tests.processes import PATIENCE, Process

codecs = pytest.importorskip("imagecodecs", reason="needs the extra frames")

DEEP = (np.arange(16 * 24, dtype=np.uint16) * 160).reshape(16, 24)
"""More than 8 bits, with something in the lower ones."""


def shot(levels: Any, format: str = "Mono8", **other: Any) -> Frame:
    height, width = levels.shape[:2]
    now = time.monotonic()
    about: dict[str, Any] = {
        "data": levels.tobytes(),
        "format": find_format(format),
        "width": width,
        "height": height,
        "stride": levels.strides[0],
        "captured": now,
        "utc": 1_800_000_000.25,
        "moment": Moment.EXPOSURE_START,
        "sequence": 1,
        "source": "shelf",
    }
    return Frame(**(about | other))


class Shelf(ShowingDriver):
    """Gives the frames that a test put there, one after the other, and then ends or does not."""

    frames: tuple[Frame, ...] = ()
    found: tuple[FoundSource, ...] = ()
    ends: Any = "not"
    fails: BaseException | None = None
    period = 0.005

    @classmethod
    async def discover(cls) -> list[FoundSource]:
        if cls.fails is not None:
            raise cls.fails
        return list(cls.found)

    @property
    def name(self) -> str:
        return "shelf"

    async def open(self) -> StreamFormat:
        if self.fails is not None:
            raise self.fails
        return StreamFormat(find_format("Mono8"), 24, 16)

    async def show(self, sink: FrameSink) -> None:
        for one in self.frames:
            sink.frame(one)
            await asyncio.sleep(self.period)
        if self.ends != "not":
            sink.ended(self.ends)


Puts = Callable[..., None]


@pytest.fixture
def shelf(monkeypatch: pytest.MonkeyPatch) -> Puts:
    """Register ``shelf://``; yield the function that puts frames there."""
    monkeypatch.setattr(FRAMES, "_registered", {"shelf": Shelf})
    monkeypatch.setattr(FRAMES, "_loaded", {})

    def put(*frames: Frame, **other: Any) -> None:
        monkeypatch.setattr(Shelf, "frames", frames)
        for name, value in other.items():
            monkeypatch.setattr(Shelf, name, value)

    return put


# ---------------------------------------------------------------------- list


def test_list_shows_devices_formats_and_remarks(shelf: Puts) -> None:
    formats = (
        StreamFormat(find_format("YUYV"), 640, 480, (30.0, 7.5)),
        StreamFormat(find_format("MJPG"), 1280, 720),
    )
    shelf(found=(FoundSource("shelf://a", "a shelf", formats, "in use by another program"),))
    out = run("frames", "list", "--scheme", "shelf").done().out
    assert out.splitlines() == [
        "shelf://a  a shelf",
        "  YUV422_8 640x480 at 30, 7.5/s",
        "  MJPEG 1280x720",
        "  in use by another program",
    ]
    (told,) = run("frames", "list", "--scheme", "shelf", "--json").done().lines
    assert (told["url"], told["remark"]) == ("shelf://a", "in use by another program")
    assert told["formats"][0] == {
        "format": "YUV422_8", "width": 640, "height": 480, "rates": [30.0, 7.5],
    }  # fmt: skip


def test_list_of_nothing_says_what_was_looked_for(shelf: Puts) -> None:
    shelf(found=())
    assert run("frames", "list", "--scheme", "shelf").done().out == (
        "nothing found; looked for: shelf\n"
    )
    assert run("frames", "list", "--scheme", "shelf", "--json").done().out == ""


def test_list_of_what_is_not_looked_for_reports_it() -> None:
    done = run("frames", "list", "--scheme", "synthetic").done()
    assert done.out == "synthetic:// has no search: open its sources by their URLs\n"
    assert "synthetic" not in run("frames", "list").done().out


def test_list_goes_on_after_a_driver_that_fails(shelf: Puts) -> None:
    shelf(fails=RuntimeError("broken"))
    done = run("frames", "list").done()
    assert "shelf: the search failed: RuntimeError('broken')\n" in done.out
    told = [one for one in run("frames", "list", "--json").done().lines if "error" in one]
    assert {"scheme": "shelf", "error": "RuntimeError('broken')"} in told


def test_list_has_a_bound(shelf: Puts, monkeypatch: pytest.MonkeyPatch) -> None:
    async def search(_cls: type[Shelf]) -> list[FoundSource]:
        await asyncio.Event().wait()
        return []

    monkeypatch.setattr(Shelf, "discover", classmethod(search))
    done = run("frames", "list", "--scheme", "shelf", "--timeout", "0.05").done()
    assert "the search took longer than 0.05 s" in done.out


def test_list_of_an_unknown_scheme_names_the_known() -> None:
    run("frames", "list", "--scheme", "v4l").failed(2, "unknown scheme 'v4l'", "v4l2://")


# ---------------------------------------------------------------------- grab


def grab(*arguments: str) -> Any:
    return run("frames", "grab", "shelf://", *arguments)


@pytest.mark.parametrize("suffix", ["png", "jxl"])
def test_grab_keeps_sixteen_bits(shelf: Puts, tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"x.{suffix}"
    shelf(shot(DEEP, "Mono16"))
    grab("-o", str(file)).done()
    decode = {"png": codecs.png_decode, "jxl": codecs.jpegxl_decode}[suffix]
    assert np.array_equal(decode(file.read_bytes()), DEEP)


def test_grab_tells_what_it_wrote(shelf: Puts, tmp_path: Path) -> None:
    file = tmp_path / "x.raw"
    shelf(shot(DEEP, "Mono16", sequence=41, lost=2))
    (told,) = grab("-o", str(file), "--json").done().lines
    assert told == {
        "file": str(file), "size": 768, "source": "shelf", "format": "Mono16", "width": 24,
        "height": 16, "stride": 48, "sequence": 41, "lost": 2,
        "captured": "2027-01-15T08:00:00.250000+00:00", "moment": "start of exposure",
    }  # fmt: skip
    assert file.read_bytes() == DEEP.tobytes()
    assert grab("-o", str(file), "--force").done().out == (
        f"{file}: Mono16 24x16, number 41, 768 bytes\n"
    )


def test_grab_refuses_to_lose_bits_unless_told(shelf: Puts, tmp_path: Path) -> None:
    file = tmp_path / "x.jpg"
    shelf(shot(DEEP >> 4, "Mono12"))
    grab("-o", str(file)).failed(2, "shelf sends Mono12, and a JPEG has 8 bits", "--8-bit")
    assert not file.exists()
    grab("-o", str(file), "--8-bit", "--quality", "100").done()
    seen = codecs.jpeg_decode(file.read_bytes())
    assert np.abs(seen.astype(int) - (DEEP >> 8)).max() < 6


def test_grab_writes_the_array_as_it_came(shelf: Puts, tmp_path: Path) -> None:
    yuyv = np.arange(8 * 16 * 2, dtype=np.uint8).reshape(8, 16, 2)
    shelf(shot(yuyv, "YUYV", width=16))
    grab("-o", str(tmp_path / "x.npy")).done()
    assert np.array_equal(np.load(tmp_path / "x.npy").reshape(8, 16, 2), yuyv)
    grab("-o", str(tmp_path / "grey.npy"), "--grey").done()
    assert np.array_equal(np.load(tmp_path / "grey.npy"), yuyv[..., 0])


def test_grab_keeps_colours_and_takes_brightness_where_asked(shelf: Puts, tmp_path: Path) -> None:
    red = np.zeros((8, 16, 3), np.uint8)
    red[..., 0] = 200
    shelf(shot(red, "RGB8"))
    for name, more in (("red.png", ()), ("grey.png", ("--grey",))):
        grab("-o", str(tmp_path / name), *more).done()
    assert np.array_equal(codecs.png_decode((tmp_path / "red.png").read_bytes()), red)
    grey = codecs.png_decode((tmp_path / "grey.png").read_bytes())
    assert (grey.shape, int(grey[0, 0])) == ((8, 16), 60)


def test_grab_writes_a_cameras_jpeg_as_it_came(shelf: Puts, tmp_path: Path) -> None:
    data = codecs.jpeg_encode(stripes(64, 32), level=40)
    levels = np.frombuffer(data, np.uint8)[None]
    shelf(shot(levels, "MJPEG", width=64, height=32, stride=0))
    grab("-o", str(tmp_path / "x.jpg"), "--quality", "99").done()
    assert (tmp_path / "x.jpg").read_bytes() == data


def test_grab_numbers_several_and_says_what_it_missed(shelf: Puts, tmp_path: Path) -> None:
    shots = [shot(stripes(24, 16), sequence=one, lost=int(one > 1)) for one in range(1, 60)]
    shelf(*shots)
    done = grab("-o", str(tmp_path / "x.png"), "--count", "3", "--json")
    assert done.code == 0
    assert [Path(one["file"]).name for one in done.lines] == [
        "x-0001.png", "x-0002.png", "x-0003.png",
    ]  # fmt: skip
    numbers = [one["sequence"] for one in done.lines]
    assert numbers == sorted(set(numbers))
    assert re.fullmatch(r"note: \d+ skipped, \d+ lost\n", done.err)
    grab("-o", str(tmp_path / "x.png"), "--count", "9").failed(
        2, "x-0001.png: the file exists already"
    )


def test_grab_after_now_waits_past_what_was_on_its_way(shelf: Puts, tmp_path: Path) -> None:
    old = shot(DEEP, "Mono16", captured=time.monotonic() - 5.0)
    fresh = shot(DEEP, "Mono16", captured=time.monotonic() + 60.0, sequence=3)
    shelf(old, dataclasses.replace(old, sequence=2), fresh)
    file = str(tmp_path / "x.png")
    (told,) = grab("-o", file, "--json").done().lines
    assert told["sequence"] == 1
    (told,) = grab("-o", file, "--force", "--after-now", "--json").done().lines
    assert told["sequence"] == 3


def test_grab_of_a_source_that_ends_too_early_keeps_what_came(shelf: Puts, tmp_path: Path) -> None:
    shelf(shot(DEEP, "Mono16"), ends=None)
    done = grab("-o", str(tmp_path / "x.png"), "--count", "2")
    assert done.code == 3
    assert "it ended after 1 frames; expected 2" in done.err
    assert [one.name for one in tmp_path.iterdir()] == ["x-0001.png"]


@pytest.mark.parametrize(
    ("fails", "code"),
    [
        (FrameSourceError("shelf: no such device; there are a, b"), 3),
        (FrameFormatError("shelf: it has no YUYV; it has Mono8 24x16"), 5),
    ],
)
def test_grab_of_what_cannot_be_opened_says_why(
    shelf: Puts, tmp_path: Path, fails: FrameSourceError, code: int
) -> None:
    shelf(fails=fails)
    grab("-o", str(tmp_path / "x.png")).failed(code, str(fails))
    told = json.loads(grab("-o", str(tmp_path / "x.png"), "--json").err)
    assert (told["error"], told["exit_code"]) == (type(fails).__name__, code)


def test_grab_if_no_frame_comes_ends(shelf: Puts, tmp_path: Path) -> None:
    shelf()
    done = grab("-o", str(tmp_path / "x.png"), "--timeout", "0.05")
    assert done.code in {3, 4}  # none in time, or stuck: which is noticed first is as it comes
    assert "shelf: " in done.err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("synthetic://", "-o", "x.gif"), "expected a name that ends with .jpeg, .jpg"),
        (("synthetic://",), "Missing option '-o'"),
        (("synthetic://", "-o", "x.raw", "--grey"), "no --grey or --8-bit"),
        (("synthetic://", "-o", "x.png", "--count", "0"), "0 is not in the range"),
        (("synthetic://", "-o", "nowhere/x.png"), "there is no folder nowhere"),
        (("synthetc://", "-o", "x.png"), "did you mean 'synthetic'?"),
        (("synthetic://?fbs=3", "-o", "x.png"), "did you mean 'fps'?"),
        (("synthetic://?fps=many", "-o", "x.png"), "expected a number from"),
    ],
)
def test_grab_with_wrong_use_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run("frames", "grab", *arguments)
    assert done.code == 2
    assert text in done.err
    assert list(tmp_path.iterdir()) == []


def test_grab_of_what_cannot_be_written_reports_it(shelf: Puts, tmp_path: Path) -> None:
    shelf(*[shot(DEEP, "Mono16")] * 60)
    (tmp_path / "x-0002.png").mkdir()
    done = grab("-o", str(tmp_path / "x.png"), "--count", "2", "--force")
    assert done.code == 2
    assert "x-0002.png: cannot be written: Is a directory" in done.err


# ---------------------------------------------------------------------- measure


def test_measure_tells_rate_losses_and_latency() -> None:
    done = run("frames", "measure", "synthetic://?fps=100&size=256x16", "--seconds", "0.3")
    text = done.done().out
    assert text.startswith("synthetic: Mono8 256x16, ")
    for row in ("rate ", "interval ", "age ", "latency ", "lost ", "CPU "):
        assert f"\n  {row}" in text
    assert "by the stamp in " in text


def stamped(number: int, *, ago: float, **other: Any) -> Frame:
    picture = stripes(256, 16)
    write_stamp(picture, number, time.monotonic_ns() - int(ago * 1e9))
    return shot(picture, sequence=number, **other)


@pytest.mark.real_time
async def test_measure_counts_by_the_capture_times(shelf: Puts) -> None:
    begun = time.monotonic() - 10.0
    shelf(
        *(
            stamped(one, ago=2.0, captured=begun + one / 50, lost=2 * (one == 3))
            for one in range(1, 6)
        ),
        ends=None,
        period=0.02,
    )
    async with open_frames("shelf://") as source:
        value = await measure(source, 60.0)
    assert value["frames"] + value["skipped"] == 5
    assert value["lost"] == 2
    assert value["rate"] == pytest.approx(50)
    if not value["skipped"]:
        assert value["interval_ms"] == pytest.approx(20)
        assert value["jitter_ms"] == pytest.approx(0, abs=0.01)
    assert value["stamps"] >= 1
    assert value["latency_ms"]["median"] >= 2000
    assert value["moment"] == "start of exposure"


@pytest.mark.real_time
@pytest.mark.parametrize("ago", [-1000.0, 1000.0, None])
async def test_measure_takes_no_stamp_of_another_clock(shelf: Puts, ago: float | None) -> None:
    one = shot(stripes(256, 16)) if ago is None else stamped(1, ago=ago)
    shelf(one, ends=None)
    async with open_frames("shelf://") as source:
        value = await measure(source, 60.0)
    assert (value["latency_ms"], value["stamps"], value["rate"]) == (None, 0, None)
    json.dumps(value)


def test_measure_of_one_frame_says_what_is_not_known(shelf: Puts) -> None:
    shelf(shot(DEEP, "Mono16"), ends=None)
    out = run("frames", "measure", "shelf://").done().out
    assert "rate      not known" in out
    assert "latency   not known: the pictures have no stamp of this machine's clock" in out


@pytest.mark.parametrize(
    ("ends", "text"),
    [
        (None, "it ended before its first frame"),
        (FrameSourceError("shelf: it was unplugged"), "shelf: it was unplugged"),
    ],
)
def test_measure_of_a_source_that_ends_at_once_fails(shelf: Puts, ends: Any, text: str) -> None:
    shelf(ends=ends)
    run("frames", "measure", "shelf://").failed(3, text)


def test_measure_of_a_source_that_dies_reports_it(shelf: Puts) -> None:
    shelf(shot(DEEP, "Mono16"), ends=FrameSourceError("shelf: it was unplugged"))
    run("frames", "measure", "shelf://").failed(3, "shelf: it was unplugged")


def test_measure_of_a_source_that_falls_silent_ends(shelf: Puts) -> None:
    shelf(shot(DEEP, "Mono16"))
    done = run("frames", "measure", "shelf://", "--timeout", "0.1", "--seconds", "60")
    assert done.code in {3, 4}


# ---------------------------------------------------------------------- show


def test_show_serves_pictures_until_ctrl_c() -> None:
    sources = ("synthetic://?name=left", "synthetic://?name=right")
    with Process("smartcam", "frames", "show", *sources, "--json") as process:
        page = json.loads(process.read_until(b"\n"))["page"]
        with urllib.request.urlopen(f"{page}api/sources", timeout=PATIENCE) as answer:  # noqa: S310
            told = json.load(answer)["sources"]
        with urllib.request.urlopen(  # noqa: S310 - http
            f"{page}api/sources/1/picture", timeout=PATIENCE
        ) as answer:
            assert codecs.jpeg_decode(answer.read()).shape == (480, 640)
        process.send_signal(signal.SIGINT)
        ended = process.wait()
    assert [(one["name"], one["started"]) for one in told] == [("left", 0), ("right", 0)]
    assert (ended.code, ended.err) == (0, "")


def test_show_awaits_a_source_that_is_not_there(shelf: Puts) -> None:
    shelf(fails=FrameSourceError("shelf: no such device"))
    done = run("frames", "show", "shelf://", "synthetic://", "--seconds", "0.05")
    assert done.code == 0
    assert done.out.startswith("page: http://127.0.0.1:")
    assert done.err == "note: shelf: no such device; waiting for it\n"


def test_show_of_a_format_that_is_not_there_ends(shelf: Puts) -> None:
    shelf(fails=FrameFormatError("shelf: it has no YUYV"))
    run("frames", "show", "shelf://").failed(5, "shelf: it has no YUYV")
    done = run("frames", "show", "synthetic://", "shelf://", "--seconds", "0.05")
    assert (done.code, done.err) == (0, "note: shelf: it has no YUYV; waiting for it\n")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "Missing argument 'URL...'"),
        (("synthetic://",) * 5, "expected 4 URLs at most, got 5"),
        (("synthetic://", "nothing://"), "unknown scheme 'nothing'"),
        (("synthetic://", "--web-token", "short"), "16 letters"),
        (("synthetic://", "--quality", "0"), "0 is not in the range"),
    ],
)
def test_show_with_wrong_use_is_reported(arguments: tuple[str, ...], text: str) -> None:
    done = run("frames", "show", *arguments)
    assert done.code == 2
    assert text in done.err
    assert done.out == ""


def test_wrong_use_is_reported_as_json() -> None:
    done = run("frames", "grab", "synthetic://", "--json")
    assert json.loads(io.StringIO(done.err).read())["exit_code"] == 2
