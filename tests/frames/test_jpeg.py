"""JPEGs of cameras: whole ones are read with a remark, damaged ones are refused."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam import frames
from smartcam.exceptions import FrameFormatError
from tests.frames.pictures import frame_of

image = pytest.importorskip("PIL.Image")
cv2 = pytest.importorskip("cv2")


def compressed(data: bytes) -> frames.Frame:
    """Return a frame of a JPEG, as a camera sends it."""
    whole = frame_of(picture(), "RGB8")
    return replace(whole, data=data, format=frames.find_format("MJPEG"), stride=0)


def picture() -> Any:
    blocks = np.arange(0, 240, 5, dtype=np.uint8).reshape(6, 8)
    plane = np.kron(blocks, np.ones((8, 8), np.uint8))
    return np.stack([plane, plane[::-1], plane[:, ::-1]], axis=2)


def jpeg(**options: Any) -> bytes:
    out = io.BytesIO()
    image.fromarray(picture()).save(out, "JPEG", quality=90, **options)
    return out.getvalue()


def restarts(data: bytes) -> list[int]:
    scan = data.index(b"\xff\xda")
    return [at for at in range(scan, len(data) - 1) if data[at] == 255 and data[at + 1] // 8 == 26]


PLAIN, MARKED, TWICE = jpeg(), jpeg(restart_marker_blocks=1), jpeg(restart_marker_blocks=4)
FIRST, *_, LAST = restarts(MARKED)
TABLE, SCAN = PLAIN.index(b"\xff\xdb"), PLAIN.index(b"\xff\xda")

WHOLE = {
    "bytes before a restart mark": MARKED[:FIRST] + b"\x12\x34\x56" + MARKED[FIRST:],
    "zeros before a restart mark": MARKED[:FIRST] + b"\0\0" + MARKED[FIRST:],
    "bytes before two marks": MARKED[:FIRST] + b"\0" + MARKED[FIRST:LAST] + b"\7\7" + MARKED[LAST:],
    "a byte before a table": PLAIN[:TABLE] + b"\0" + PLAIN[TABLE:],
    "bytes before the frame's head": PLAIN[: PLAIN.index(b"\xff\xc0")]
    + b"\x01\xff\x00"
    + PLAIN[PLAIN.index(b"\xff\xc0") :],
    "a byte before the scan": PLAIN[:SCAN] + b"\0" + PLAIN[SCAN:],
    "bytes before the end mark": PLAIN[:-2] + b"\0\0\0\0" + PLAIN[-2:],
    "a revision of JFIF that is unknown": PLAIN.replace(b"JFIF\0\x01\x01", b"JFIF\0\x02\x07"),
}
"""Pictures that libjpeg decodes whole, by Pillow and by OpenCV."""


@pytest.mark.parametrize("name", WHOLE)
def test_whole_picture_is_read_and_remarked_on(name: str) -> None:
    data = WHOLE[name]
    wanted = compressed(PLAIN).rgb()
    others = (
        np.asarray(image.open(io.BytesIO(data)).convert("RGB")),
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1],
    )
    for one in others:
        assert np.abs(one.astype(int) - wanted).max() <= 2
    assert np.array_equal(compressed(data).rgb(), wanted)


async def test_decoded_frame_has_the_remark() -> None:
    first = restarts(TWICE)[0]
    data = TWICE[:first] + b"\0\0\0" + TWICE[first:]
    async with frames.Codecs() as codecs:
        assert (await codecs.decode(compressed(TWICE))).remark == ""
        decoded = await codecs.decode(compressed(data))
    assert "3 extraneous bytes before marker 0xd0" in decoded.remark
    assert np.array_equal(decoded.array(), compressed(data).rgb())


@pytest.mark.parametrize("name", WHOLE)
async def test_whole_picture_is_read_from_a_file(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.jpg").write_bytes(WHOLE[name])
    async with frames.open(str(tmp_path / "a.jpg")) as source:
        got = (await source.newest()).rgb().astype(int)
    assert np.abs(got - picture()).mean() < 8


DAMAGED = {
    "cut off in the scan": PLAIN[: len(PLAIN) * 2 // 3],
    "without its end mark": PLAIN[:-2],
    "an interval is gone": MARKED[:FIRST] + MARKED[restarts(MARKED)[1] :],
    "two intervals changed places": MARKED[:FIRST]
    + MARKED[restarts(MARKED)[1] : restarts(MARKED)[2]]
    + MARKED[FIRST : restarts(MARKED)[1]]
    + MARKED[restarts(MARKED)[2] :],
    "an interval ends early": MARKED[: FIRST - 6] + MARKED[FIRST:],
    "ends early, and bytes before the last mark": MARKED[: FIRST - 6]
    + MARKED[FIRST:LAST]
    + b"\0"
    + MARKED[LAST:],
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_picture_is_refused(name: str) -> None:
    with pytest.raises(FrameFormatError, match="expected a whole JPEG"):
        compressed(DAMAGED[name]).rgb()
