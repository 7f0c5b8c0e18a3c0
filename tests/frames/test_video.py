"""Streams and files through FFmpeg: real servers on the loopback, and videos made here."""

from __future__ import annotations

import asyncio
import logging
import random
import threading
import traceback
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam import frames
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    MessageError,
    MissingExtraError,
)
from smartcam.frames import Codecs, Moment
from smartcam.frames._inside import read_stamp
from smartcam.frames._video import driver as video
from tests.frames.inside import (
    MAX_BYTES_BETWEEN,
    MAX_PICTURE_BYTES,
    PictureCutter,
    SenderReport,
    decode_jpeg,
    ntp_time,
)
from tests.frames.pictures import (
    HEIGHT,
    MULTIPART,
    PARTS,
    WIDTH,
    frame_of,
    jpeg,
    length,
    part,
    rtp_packets,
    rtsp_answers,
    served,
    stamped,
    write_video,
)

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.frames import Frame, FrameSource

SOON = "timeout=0.3"
"""Seconds of real time that a test waits for a silent server."""
LATER = "timeout=2"
"""Seconds for a server that answers at first and is silent then, even on a slow machine."""


def threads() -> set[threading.Thread]:
    return {one for one in threading.enumerate() if one.name.startswith("frames of")}


@pytest.fixture(autouse=True)
def _no_thread_stays() -> Any:
    before = threads()
    yield
    for one in threads() - before:
        one.join(60)
    assert threads() - before == set()


async def numbers(source: FrameSource) -> list[int | None]:
    found = []
    async for frame in source:
        stamp = read_stamp(frame.grey())
        found.append(stamp and stamp[0])
    return found


# files


@pytest.mark.parametrize(
    ("codec", "pixels", "end", "format"),
    [
        ("mpeg4", "yuv420p", "mp4", "I420"),
        ("libx264", "yuv420p", "mp4", "I420"),
        ("libx264", "yuv422p", "mkv", "I422"),
        ("mjpeg", "yuvj420p", "mkv", "I420_full"),
        ("mjpeg", "yuvj422p", "avi", "I422_full"),
        ("ffv1", "gray", "mkv", "Mono8"),
        ("ffv1", "gray16le", "mkv", "Mono16"),
        ("ffv1", "yuv444p", "mkv", "I444"),
        ("rawvideo", "bgr24", "avi", "BGR8"),
    ],
)
async def test_file_gives_each_picture_as_its_decoder_has_it(
    tmp_path: Path, codec: str, pixels: str, end: str, format: str
) -> None:
    path = write_video(tmp_path / f"video.{end}", codec, pixels)
    async with frames.open(f"{path}#pace=none") as source:
        assert str(source.format) == f"{format} {WIDTH}x{HEIGHT} at 20/s"
        reader = source.reader()
        got = [frame async for frame in reader]
        assert [frame.sequence for frame in got] == list(range(1, 11))
        assert reader.statistics().skipped == 0
    for number, frame in enumerate(got):
        assert (frame.format.name, frame.width, frame.height) == (format, WIDTH, HEIGHT)
        assert (frame.lost, frame.moment, frame.source) == (0, Moment.ARRIVAL, path)
        assert read_stamp(frame.grey() // (256 if format == "Mono16" else 1)) == (
            number,
            number * 1000,
        )
        assert frame.rgb().shape == (HEIGHT, WIDTH, 3)


async def test_file_plays_in_its_own_time(tmp_path: Path) -> None:
    path = write_video(tmp_path / "video.mkv", "ffv1", "gray")
    loop = asyncio.get_running_loop()
    for fragment, seconds in (("", 9 / 20), ("#fps=2", 9 / 2)):
        async with frames.open(path + fragment) as source:
            came = [(read_stamp(frame.grey()), loop.time()) async for frame in source]
        assert [stamp and stamp[0] for stamp, _ in came] == list(range(10))
        assert came[-1][1] - came[0][1] >= seconds - 0.001


async def test_slow_reader_loses_nothing_of_a_file_without_pace(tmp_path: Path) -> None:
    path = write_video(tmp_path / "video.mkv", "ffv1", "gray")
    async with frames.open(f"{path}#pace=none", stall=1.0) as source:
        fast, slow = source.reader(timeout=None), source.reader(timeout=None)

        async def every(reader: Any, pause: float) -> list[int]:
            found = []
            async for frame in reader:
                found.append(frame.sequence)
                await asyncio.sleep(pause)  # of the loop's simulated time
            return found

        found = await asyncio.gather(every(fast, 0), every(slow, 20))
    assert list(found) == [[*range(1, 11)]] * 2


async def test_each_reader_after_the_end_begins_at_the_beginning(tmp_path: Path) -> None:
    path = write_video(tmp_path / "video.mkv", "ffv1", "gray")
    async with frames.open(f"file://{path}#pace=none") as source:
        assert await numbers(source) == [*range(10)]
        assert await numbers(source) == [*range(10)]
        assert source.statistics().started == 2


async def test_pixels_are_converted_on_request(tmp_path: Path) -> None:
    path = write_video(tmp_path / "video.mkv", "ffv1", "yuv420p")
    for name in ("RGB8", "BGR8", "Mono8"):
        async with frames.open(f"{path}#pace=none&format={name}") as source:
            frame = await source.newest()
            assert frame.format.name == source.format.format.name == name
            assert read_stamp(frame.array()) is not None


@pytest.mark.parametrize(
    ("codec", "pixels", "format"), [("mjpeg", "yuvj420p", "MJPEG"), ("libx264", "yuv420p", "H264")]
)
async def test_bytes_are_passed_on_unchanged(
    tmp_path: Path, codec: str, pixels: str, format: str
) -> None:
    path = write_video(tmp_path / "video.mp4", codec, pixels)
    async with frames.open(f"{path}#pace=none&format={format}") as source, Codecs() as codecs:
        decoder = codecs.h264_decoder()
        found = []
        async for frame in source:
            assert (frame.format.name, frame.stride) == (format, 0)
            assert (frame.width, frame.height) == (WIDTH, HEIGHT)
            picture = await decoder.decode(frame) if format == "H264" else frame
            if picture is not None:
                found.append(read_stamp(picture.grey()))
        assert found[:5] == [(number, number * 1000) for number in range(5)]


async def test_pictures_of_a_folder_or_pattern_come_by_name(tmp_path: Path) -> None:
    for number in (2, 0, 1):
        (tmp_path / f"shot{number}.jpg").write_bytes(jpeg(number))
    (tmp_path / "notes.txt").write_text("no picture")
    loop = asyncio.get_running_loop()
    for path in (str(tmp_path), f"{tmp_path}/shot*.jpg"):
        async with frames.open(f"{path}#fps=4") as source:
            begun = loop.time()
            assert await numbers(source) == [0, 1, 2]
            assert loop.time() - begun >= 0.5
            assert str(source.format) == f"Mono8 {WIDTH}x{HEIGHT} at 4/s"
    (tmp_path / "shot3.jpg").write_bytes(jpeg(3, 256, 32))
    async with frames.open(f"{tmp_path}#pace=none") as source:
        with pytest.raises(FrameFormatError, match=r"as it was opened, got Mono8 256x32"):
            await numbers(source)
    async with frames.open(f"{tmp_path}/shot1.jpg") as source:
        assert await numbers(source) == [1]


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("none.mp4", "cannot be read: No such file or directory"),
        ("text.mp4", "cannot be read: Invalid data"),
        ("empty.mp4", "cannot be read: "),
        ("*.png", "there is no picture"),
    ],
)
async def test_file_without_video_is_an_error(tmp_path: Path, file: str, message: str) -> None:
    (tmp_path / "text.mp4").write_text("no video at all\n" * 100)
    (tmp_path / "empty.mp4").write_bytes(b"")
    source = frames.open(str(tmp_path / file))
    with pytest.raises(FrameSourceError, match=message) as got:
        await source.__aenter__()
    assert got.value.source == str(tmp_path / file)
    assert str(tmp_path / file) in str(got.value)


async def test_damaged_pictures_of_a_file_are_lost_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "video.mkv"
    write_video(path, "mjpeg", "yuvj420p")
    data = bytearray(path.read_bytes())
    starts = [at for at in range(len(data)) if data[at : at + 3] == b"\xff\xd8\xff"]
    assert len(starts) == 10
    middle = (starts[4] + starts[5]) // 2
    data[middle : middle + 300] = bytes(300)
    path.write_bytes(data)
    async with frames.open(f"{path}#pace=none") as source:
        reader = source.reader()
        got = [frame async for frame in reader]
        assert [read_stamp(frame.grey()) for frame in got] == [
            (number, number * 1000) for number in range(10) if number != 4
        ]
        assert [frame.lost for frame in got] == [0, 0, 0, 0, 1, 0, 0, 0, 0]
        assert got[4].sequence == 6
        assert reader.statistics().lost == source.statistics().lost == 1


# addresses


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("rtsp://h/x#transport=quic", "transport: expected tcp or udp, got 'quic'"),
        ("rtsp://h/x#pace=none", "unknown parameter 'pace'; known are delay, elsewhere,"),
        ("http://h/x#transport=tcp", "unknown parameter 'transport'"),
        ("x.mp4#pace=fast", "pace: expected real or none, got 'fast'"),
        ("x.mp4#timeout=0", "timeout: expected a number from 0.1 to 600"),
        ("x.mp4#format=NV12", "format: expected one of RGB8, BGR8, Mono8, MJPEG, H264, got 'NV12'"),
        ("x.mp4#format=x", "format: expected one of RGB8"),
        ("file://x/y.mp4", "expected file:///PATH"),
    ],
)
def test_wrong_parameters_are_refused_with_the_cure(url: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as got:
        frames.open(url)
    assert message in str(got.value)


def test_query_is_the_server_s_and_a_path_may_have_a_sharp() -> None:
    made = video.VideoDriver(frames.FrameAddress.parse("rtsp://h/x?transport=9#transport=udp"))
    assert made._options["rtsp_transport"] == "udp"
    made = video.VideoDriver(frames.FrameAddress.parse("take#1/a#b.mp4#pace=none"))
    assert (made.name, made._keeps_pace) == ("take#1/a#b.mp4", False)
    made = video.VideoDriver(frames.FrameAddress.parse("take#1/a#b.mp4"))
    assert (made.name, made._keeps_pace) == ("take#1/a#b.mp4", True)


def test_certificates_are_checked_unless_switched_off() -> None:
    for url, verified in (
        ("https://h/x", "1"),
        ("rtsps://h/x", "1"),
        ("https://h/x#verify=no", "0"),
    ):
        assert video.VideoDriver(frames.FrameAddress.parse(url))._options["tls_verify"] == verified


async def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"smartcam\[video\]"):
        await frames.open("x.mp4").__aenter__()


# MJPEG over HTTP


class Camera:
    """An MJPEG camera whose bytes and next action are the same for each client."""

    def __init__(self) -> None:
        self.requests: list[str] = []
        self.pictures = [jpeg(number) for number in range(6)]
        self.then = "goes on"
        self.answer = MULTIPART
        self.gone = 0

    async def serve(self, reader: Any, writer: Any) -> None:
        self.requests.append((await reader.readuntil(b"\r\n\r\n")).decode())
        try:
            if self.then == "says nothing":
                await asyncio.sleep(1e6)
            writer.write(self.answer)
            while True:
                for picture in self.pictures:
                    writer.write(part(picture))
                    await writer.drain()
                    await asyncio.sleep(0.005)
                if self.then == "dies":
                    return
                if self.then == "ends":  # and no byte sent before is lost
                    writer.write_eof()
                    await reader.read()
                    return
                if self.then == "stalls":
                    await asyncio.sleep(1e6)
        finally:
            self.gone += 1


@pytest.mark.parametrize("challenge", ['Digest realm="x", nonce="1"', 'Basic realm="x"'])
async def test_camera_may_close_the_connection_after_its_challenge(challenge: str) -> None:
    camera = Camera()
    refused: list[str] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = (await reader.readuntil(b"\r\n\r\n")).decode()
        if "Authorization" in request:
            reader.feed_data(request.encode())
            await camera.serve(reader, writer)
            return
        refused.append(request)
        answer = f"HTTP/1.1 401 Unauthorized\r\nWWW-Authenticate: {challenge}\r\nConnection: close"
        writer.write(f"{answer}\r\n\r\n".encode())
        writer.write_eof()
        await reader.read()

    async with (
        served(serve) as port,
        frames.open(f"http://admin:s3cret@127.0.0.1:{port}/video#timeout=2") as source,
    ):
        assert (await source.newest()).format.name == "Mono8"
    assert refused
    assert all("Authorization" in request for request in camera.requests)


async def test_camera_is_read_and_its_query_left_to_it() -> None:
    camera = Camera()
    async with served(camera.serve) as port:
        url = f"http://admin:s3cret@127.0.0.1:{port}/video?fps=7&token=t0ken#delay=0.5"
        async with frames.open(url) as source:
            assert str(source.format) == f"Mono8 {WIDTH}x{HEIGHT}"
            got: list[Frame] = []
            async for frame in source:
                got.append(frame)
                if len(got) == 5:
                    break
        stamps = [read_stamp(frame.grey()) for frame in got]
        assert all(stamp is not None and stamp[1] == 1000 * stamp[0] for stamp in stamps)
        assert all("GET /video?fps=7&token=t0ken HTTP" in one for one in camera.requests)
        assert [frame.moment for frame in got] == [Moment.ARRIVAL] * 5
        assert {frame.duration for frame in got} == {0.5}
        assert {frame.source for frame in got} == {f"http://admin:***@127.0.0.1:{port}/video"}
        assert {frame.device_time for frame in got} == {None}
        assert [frame.captured for frame in got] == sorted(frame.captured for frame in got)


@pytest.mark.parametrize(
    ("then", "message"),
    [
        ("dies", "the server ended the stream|cannot be read: "),
        ("stalls", "expected a picture, got no bytes for 2 s"),
    ],
)
async def test_lost_or_stalled_server_ends_readers_and_the_next_reconnects(
    then: str, message: str
) -> None:
    camera = Camera()
    async with (
        served(camera.serve) as port,
        frames.open(f"http://127.0.0.1:{port}/#{LATER}") as source,
    ):
        camera.then = then
        with pytest.raises(FrameSourceError, match=message) as got:
            await numbers(source)
        assert got.value.source == f"http://127.0.0.1:{port}/"
        camera.then = "goes on"
        assert (await source.newest()).format.name == "Mono8"
        assert source.statistics().started == 2
    # an older FFmpeg follows redirects, so the camera is asked for one first
    assert len(camera.requests) == camera.gone
    assert camera.gone in {3, 6}


@pytest.mark.parametrize(
    ("answer", "then", "message"),
    [
        (b"HTTP/1.0 401 Unauthorized\r\n\r\n", "ends", "401 Unauthorized"),
        (b"HTTP/1.0 404 Not Found\r\n\r\n", "ends", "404 Not Found"),
        (b"HTTP/1.0 200 OK\r\n\r\nhello", "dies", "cannot be read: "),
        (b"", "dies", "cannot be read: "),
        (b"", "says nothing", "expected an answer, got none within 0.3 s"),
    ],
)
async def test_server_without_a_stream_is_reported_without_the_password(
    answer: bytes, then: str, message: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    camera = Camera()
    camera.answer, camera.then, camera.pictures = answer, then, []
    async with served(camera.serve) as port:
        soon = SOON if then == "says nothing" else ""
        url = f"http://admin:s3cret@127.0.0.1:{port}/?password=t0ken#{soon}"
        with pytest.raises(FrameSourceError, match=message) as got:
            await frames.open(url).__aenter__()
    whole = "".join(traceback.format_exception(got.value)) + repr(got.value) + caplog.text
    assert "127.0.0.1" in whole
    assert "s3cret" not in whole
    assert "t0ken" not in whole


def test_texts_of_an_address_contain_no_secrets() -> None:
    address = frames.FrameAddress.parse("http://u:s3cret@h/x?user=u&pwd=s3cret&n=1#format=H264")
    assert "s3cret" not in repr(address)
    with pytest.raises(ConfigurationError) as got:
        frames.open("rtsp://u:s3cret@h/x?Password=s3cret#transport=x")
    assert "s3cret" not in str(got.value)


async def test_nothing_listens() -> None:
    async with served(Camera().serve) as port:
        pass
    with pytest.raises(FrameSourceError, match="Connection refused"):
        await frames.open(f"http://127.0.0.1:{port}/").__aenter__()


async def test_damaged_pictures_of_a_stream_are_lost_and_counted() -> None:
    camera = Camera()
    camera.pictures[2] = camera.pictures[2][: len(camera.pictures[2]) * 3 // 4]
    camera.pictures[3] = b"\xff\xd8 no picture at all"
    async with served(camera.serve) as port, frames.open(f"http://127.0.0.1:{port}/") as source:
        found = []
        async for frame in source:
            found.append(frame)
            if len(found) == 12:
                break
    seen = {stamp and stamp[0] for stamp in (read_stamp(frame.grey()) for frame in found)}
    assert seen <= {0, 1, 4, 5}
    assert source.statistics().lost >= 2


async def test_bytes_that_never_make_a_picture_are_no_stream() -> None:
    camera = Camera()
    camera.pictures = [jpeg(0), *[b"\xff\xd8\xff no picture at all"] * 10_000]
    url = "http://127.0.0.1:{}/#" + LATER
    async with served(camera.serve) as port, frames.open(url.format(port)) as source:
        with pytest.raises(FrameFormatError, match=r"got bytes that make no picture for 2 s"):
            await numbers(source)


async def test_thread_that_exceeds_its_limits_is_abandoned_and_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    path = write_video(tmp_path / "video.mkv", "ffv1", "gray")
    gate = threading.Event()
    driver = video.VideoDriver(frames.FrameAddress.parse(f"{path}#timeout=0.1"))
    monkeypatch.setattr(video, "THREAD_GRACE", -0.05)
    monkeypatch.setattr(driver, "_open_reader", lambda: gate.wait(60))
    task = asyncio.create_task(driver.open())
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait([task])
    assert "the reader thread hangs, and is abandoned" in caplog.text
    monkeypatch.undo()
    assert (await driver.open()).width == WIDTH
    gate.set()
    await driver.close()


async def test_unforeseen_failure_ends_readers_with_its_cause(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = write_video(tmp_path / "video.mkv", "ffv1", "gray")
    async with frames.open(f"{path}#pace=none") as source:
        monkeypatch.setattr(video, "Moment", None)
        with pytest.raises(FrameSourceError, match="AttributeError") as got:
            await numbers(source)
        assert isinstance(got.value.__cause__, AttributeError)


async def test_picture_of_another_size_ends_the_stream() -> None:
    camera = Camera()
    async with served(camera.serve) as port, frames.open(f"http://127.0.0.1:{port}/") as source:
        camera.pictures = [jpeg(0), jpeg(1, 256, 32)]
        with pytest.raises(FrameFormatError, match="got 256x32: open it again") as got:
            await numbers(source)
        assert got.value.available == ("256x32",)


async def test_leaving_ends_a_read_that_hangs() -> None:
    camera = Camera()
    async with served(camera.serve) as port:
        async with frames.open(f"http://127.0.0.1:{port}/#{LATER}") as source:
            camera.then, camera.pictures = "stalls", camera.pictures[:2]
            reader = source.reader()
            await reader.newest()
        assert source.statistics().streaming is False
        for one in threads():  # while the server stalls
            await asyncio.to_thread(one.join, 60)
        assert threads() == set()


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 5, 8, 13, 40])
async def test_cancelled_opening_leaves_nothing(steps: int) -> None:
    camera = Camera()
    async with served(camera.serve) as port:
        source = frames.open(f"http://127.0.0.1:{port}/")
        task = asyncio.create_task(source.__aenter__())
        for _ in range(steps):
            await asyncio.sleep(0)
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        await source.close()
        async with frames.open(f"http://127.0.0.1:{port}/") as again:
            assert (await again.newest()).width == WIDTH


# pictures in parts

PICTURES = [jpeg(number) for number in range(8)]
THUMBNAIL = b"\xff\xd8\xff\xe1" + (len(PICTURES[0]) + 2).to_bytes(2, "big") + PICTURES[0]


@pytest.mark.parametrize("way", PARTS)
def test_each_picture_comes_with_its_last_byte(way: str) -> None:
    cutter = PictureCutter()
    got: list[bytes] = []
    for one in PICTURES:
        sent = PARTS[way](one)
        end = sent.index(one) + len(one)
        got += cutter.feed(sent[: end - 1])
        late = list(cutter.feed(sent[end - 1 : end]))
        assert late == [one]
        got += [*late, *cutter.feed(sent[end:])]
    assert (got, cutter.damaged) == (PICTURES, 0)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("way", PARTS)
def test_pieces_do_not_matter(way: str) -> None:
    chance = random.Random(1)  # noqa: S311
    whole = b"".join(PARTS[way](one) for one in PICTURES)
    for size in (1, 7, 100, 10**6):
        cutter, place = PictureCutter(), 0
        got: list[bytes] = []
        while place < len(whole):
            step = 1 + chance.randrange(size)
            got += cutter.feed(whole[place : place + step])
            place += step
        assert (got, cutter.damaged) == (PICTURES, 0)


def test_a_thumbnail_is_no_picture_of_its_own() -> None:
    with_one = THUMBNAIL + PICTURES[1][2:]
    assert list(PictureCutter().feed(with_one)) == [with_one]


def strays(picture: bytes, marker: int, more: bytes) -> bytes:
    """Return a picture with stray bytes before a segment of its head."""
    place = picture.index(bytes((0xFF, marker)))
    return picture[:place] + more + picture[place:]


@pytest.mark.parametrize("more", [b"\0", b"\x01\x02\x03", b"\xff\0", b"--b\r\n", bytes(2000)])
@pytest.mark.parametrize("marker", [0xDB, 0xC0, 0xDA])
def test_stray_bytes_in_a_head_belong_to_the_picture(marker: int, more: bytes) -> None:
    """Webcams send such bytes, and decoders skip them."""
    sent = [strays(one, marker, more) for one in PICTURES]
    whole = b"".join(b"--b\r\n\r\n" + one + b"\r\n" for one in sent)
    for size in (1, 7, 1000, len(whole)):
        cutter = PictureCutter()
        got = [
            one
            for place in range(0, len(whole), size)
            for one in cutter.feed(whole[place : place + size])
        ]
        assert (got, cutter.damaged) == (sent, 0)


@pytest.mark.parametrize("with_length", [True, False])
def test_truncated_head_takes_no_bytes_of_the_next_picture(with_length: bool) -> None:
    """The length of its last segment may reach into the next picture, wherever that is cut."""
    shown = {grey_of(one) for one in PICTURES}
    for size in range(2, PICTURES[0].index(b"\xff\xda") + 20):
        cutter, cut = PictureCutter(), PICTURES[0][:size]
        sent = b"".join(
            b"\r\n--b\r\n" + (length(one) if with_length else b"\r\n") + one
            for one in (cut, *PICTURES[1:4])
        )
        got = list(cutter.feed(sent))
        assert {grey_of(one) for one in got} <= {*shown, None}
        assert got[-2:] == PICTURES[2:4]


def grey_of(picture: bytes) -> bytes | None:
    """Return the brightness of a picture; None: the decoder refuses it."""
    try:
        return decode_jpeg(picture, "GRAY", (WIDTH, HEIGHT), "MJPEG").pixels.tobytes()
    except FrameFormatError:
        return None


def test_a_head_of_strays_alone_is_no_picture() -> None:
    cutter = PictureCutter()
    assert not list(cutter.feed(b"\xff\xd8" + b"a" * 5000))
    assert cutter.damaged == 1


def test_truncated_picture_is_counted_and_the_next_one_comes() -> None:
    cutter = PictureCutter()
    cut = PICTURES[0][: len(PICTURES[0]) // 2]
    unsaid = b"--b\r\n\r\n" + cut + b"\r\n--b\r\n\r\n" + PICTURES[1]
    assert list(cutter.feed(unsaid)) == [PICTURES[1]]
    assert cutter.damaged == 1
    stream = b"--b\r\n" + length(cut) + cut + b"\r\n--b\r\n\r\n" + PICTURES[1]
    assert list(cutter.feed(stream)) == [cut, PICTURES[1]]  # the decoder judges the picture
    cutter.damaged = 0
    assert list(cutter.feed(b"\xff\xd8 none \xff\xd8\xff\x20 none" + PICTURES[2])) == [PICTURES[2]]
    assert cutter.damaged == 2


def test_memory_and_patience_are_bounded() -> None:
    cutter, endless = PictureCutter(), PictureCutter()
    with pytest.raises(MessageError, match="belong to no picture"):
        _fed(cutter, 1000, MAX_BYTES_BETWEEN // 1000 + 20)
    list(endless.feed(PICTURES[0][:-2]))
    with pytest.raises(MessageError, match="bytes at most"):
        _fed(endless, 1 << 20, MAX_PICTURE_BYTES // (1 << 20) + 1)


def _fed(cutter: PictureCutter, size: int, count: int) -> None:
    for _ in range(count):
        assert not list(cutter.feed(bytes(size)))


# RTSP


async def test_silent_rtsp_camera_is_reported_without_the_password() -> None:
    async def serve(reader: Any, writer: Any) -> None:
        await reader.read()

    async with served(serve) as port:
        url = f"rtsp://u:s3cret@127.0.0.1:{port}/x#{SOON}"
        with pytest.raises(FrameSourceError, match=r"got none within 0\.3 s") as got:
            await frames.open(url).__aenter__()
    assert "s3cret" not in "".join(traceback.format_exception(got.value))


async def test_rtsp_camera_is_read_over_tcp_with_its_clock() -> None:
    seen: list[str] = []
    async with Codecs(threads=1) as codecs:
        encoder = codecs.h264_encoder(keyint=8, crf=18)
        sent = [
            await encoder.encode(frame_of(stamped(number), "Mono8", number)) for number in range(16)
        ]

    async def serve(reader: Any, writer: Any) -> None:
        await rtsp_answers(reader, writer, seen)
        sequence = 0
        for number in range(1000):
            if number == 10:
                report = SenderReport(7, ntp_time(1e9), 30_000, 0, 0).pack()
                writer.write(b"$\1" + len(report).to_bytes(2, "big") + report)
            packets = rtp_packets(bytes(sent[number % 16].data), sequence, number * 3000)
            sequence = sequence + len(packets) & 0xFFFF
            for packet in packets:
                writer.write(b"$\0" + len(packet).to_bytes(2, "big") + packet)
            await writer.drain()
            await asyncio.sleep(0.005)

    async with served(serve) as port:
        url = f"rtsp://admin:s3cret@127.0.0.1:{port}/stream?channel=1#transport=tcp&timeout=5"
        async with frames.open(url) as source:
            assert source.format.format.name == "I420_full"
            got: list[Frame] = []
            async for frame in source:
                got.append(frame)
                if len(got) == 40:
                    break
    for frame in got:
        stamp = read_stamp(frame.grey())
        assert stamp is not None
        assert np.abs(frame.grey().astype(int) - stamped(stamp[0])).mean() < 3
    waited = [frame.device_time is None for frame in got]  # until the camera's first report
    times = [frame.device_time for frame in got if frame.device_time is not None]
    assert waited == sorted(waited, reverse=True)
    assert len(times) > 20
    assert times == sorted(times)
    assert times[0] == pytest.approx(1e9, abs=1)
    assert any("channel=1" in one and one.startswith("DESCRIBE") for one in seen)
    assert any("RTP/AVP/TCP" in one for one in seen)
