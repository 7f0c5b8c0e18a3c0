"""Pictures from files and folders."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam._extras import load
from smartcam.calibration._inside import PictureFolder, decode_picture
from smartcam.calibration.wizards import _pictures as pictures
from smartcam.calibration.wizards._pictures import picture_taker
from smartcam.exceptions import FrameTimeoutError, LocalProtocolError
from tests.calibration.scenes import refused
from tests.frames.drivers import GoneError, frame, scripted
from tests.handmade import until

GREY = (np.arange(32 * 48) % 251).reshape(32, 48).astype(np.uint8)


def encoded(image: Any = GREY, suffix: str = ".png") -> bytes:
    data: bytes = load("cv2").imencode(suffix, image)[1].tobytes()
    return data


async def taken(folder: PictureFolder, *writes: tuple[Path, bytes]) -> Any:
    """Take a picture; the files are written after the first look at the folder."""
    task = asyncio.create_task(folder.take())
    await asyncio.sleep(0)  # up to its first wait
    for path, data in writes:
        path.write_bytes(data)
    return await task


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff"])
def test_picture_of_a_file_is_its_grey_levels(suffix: str) -> None:
    assert np.array_equal(decode_picture(encoded(suffix=suffix)), GREY)


def test_picture_of_sixteen_bits_keeps_them() -> None:
    deep = GREY.astype(np.uint16) * 200
    assert np.array_equal(decode_picture(encoded(deep)), deep)
    assert decode_picture(encoded(np.dstack([GREY] * 3))).shape == GREY.shape


@pytest.mark.parametrize("data", [b"", b"GIF89a, and no more", encoded()[:40]])
def test_invalid_picture_is_refused(data: bytes) -> None:
    with refused("BAD_PICTURE", "shot.png: expected a bitmap, JPEG, PNG or TIFF, got"):
        decode_picture(data, "shot.png")


def test_picture_that_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "MAX_PICTURE_BYTES", 100)
    with refused("BAD_PICTURE", "expected 100 bytes at most, got"):
        decode_picture(encoded())


def test_picture_with_too_many_pixels_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "MAX_SIDE_PX", 40)
    with refused("BAD_PICTURE", "expected 40 pixels along each side, got 48x32"):
        decode_picture(encoded())


async def test_folder_gives_the_picture_that_comes_not_the_one_before(tmp_path: Path) -> None:
    (tmp_path / "old.png").write_bytes(encoded(255 - GREY))
    folder = PictureFolder(tmp_path, timeout=10.0)
    image = await taken(folder, (tmp_path / "new.PNG", encoded()), (tmp_path / "note.txt", b"x"))
    assert np.array_equal(image, GREY)


async def test_folder_gives_a_picture_that_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "shot.bmp").write_bytes(encoded(GREY[:20], ".bmp"))
    image = await taken(PictureFolder(tmp_path), (tmp_path / "shot.bmp", encoded(GREY, ".bmp")))
    assert np.array_equal(image, GREY)


class Growing(PictureFolder):
    """A folder into which a picture is written, a part before each look."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.parts: list[bytes] = []
        super().__init__(path, timeout=10.0)
        self.parts = [data[start : start + 20] for start in range(0, len(data), 20)]

    def _scan_folder(self) -> dict[str, tuple[int, int]]:
        if self.parts:
            with (self.path / "shot.png").open("ab") as stream:
                stream.write(self.parts.pop(0))
        return super()._scan_folder()


async def test_folder_waits_for_a_file_that_grows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "LISTING_PERIOD", 0.001)
    folder = Growing(tmp_path, encoded())
    assert len(folder.parts) > 3
    assert np.array_equal(await folder.take(), GREY)
    assert folder.parts == []


async def test_folder_without_a_new_picture_is_an_error_in_time(tmp_path: Path) -> None:
    (tmp_path / "old.png").write_bytes(encoded())
    wanted = "expected a file that ends in one of .bmp, .jpeg"
    with refused("NO_PICTURE", f"within 0.3 s (pictures from before: 1); {wanted}"):
        await PictureFolder(tmp_path, timeout=0.3).take()


async def test_folder_with_other_new_files_names_them(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_bytes(b"here before")
    folder = PictureFolder(tmp_path, timeout=0.5)
    waiting = asyncio.create_task(folder.take())
    await asyncio.sleep(0.1)
    for name in ("a.raw", "b.raw", "c.raw", "d.raw"):
        (tmp_path / name).write_bytes(b"no picture")
    with refused(
        "NO_PICTURE", "(new files that are not pictures: a.raw, b.raw, c.raw and 1 more); expected"
    ):
        await waiting


def test_folder_describes_the_awaited_file(tmp_path: Path) -> None:
    told = PictureFolder(tmp_path, timeout=5.0).awaited
    assert (
        f"the first file written to {tmp_path} from now on counts, if its name ends in .bmp" in told
    )
    assert told.endswith("The step waits 5 s for it")


async def test_folder_with_an_invalid_picture_names_the_file(tmp_path: Path) -> None:
    with refused("BAD_PICTURE", "shot.jpg: expected a bitmap"):
        await taken(PictureFolder(tmp_path), (tmp_path / "shot.jpg", b"no picture"))


async def test_invalid_folder_is_refused(tmp_path: Path) -> None:
    with refused("NO_PICTURE", "missing: expected a folder that pictures come into"):
        PictureFolder(tmp_path / "missing")
    folder = PictureFolder(tmp_path)
    await asyncio.to_thread(tmp_path.rmdir)
    with refused("NO_PICTURE", "No such file or directory"):
        await folder.take()


def test_folder_with_too_many_files_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "MAX_FILES", 2)
    for number in range(3):
        (tmp_path / f"{number}.txt").touch()
    with refused("NO_PICTURE", "expected 2 files at most, got more"):
        PictureFolder(tmp_path)


async def test_folder_take_cancelled_leaves_nothing_open(tmp_path: Path) -> None:
    task = asyncio.create_task(PictureFolder(tmp_path).take())
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait({task})
    assert task.cancelled()


# ---------------------------------------------------------------------- sources of frames


async def test_picture_of_a_source_is_the_first_exposed_after_the_request() -> None:
    driver, source = scripted(stall=None, linger=60.0)
    take = picture_taker(source)
    async with source, source.reader() as reader:
        await driver.streams()
        driver.give(frame(1))
        assert (await anext(reader)).sequence == 1  # here before the button
        taking = asyncio.ensure_future(take())
        await until(lambda: source.statistics().readers == 2)
        driver.give(frame(2, captured=time.monotonic() - 1.0))  # exposed before
        await asyncio.sleep(1.0)
        assert not taking.done()
        driver.give(frame(3))
        picture = await taking
        assert picture.shape == (2, 4)
        assert (picture == 3).all()


async def test_picture_of_a_source_that_dies_or_is_silent_is_its_error() -> None:
    driver, source = scripted(stall=None)
    take = picture_taker(source)
    async with source:
        with pytest.raises(FrameTimeoutError):
            await take()
        await driver.rests()
        taking = asyncio.ensure_future(take())
        await driver.streams()
        assert driver.sink is not None
        driver.sink.ended(GoneError("scripted: it was unplugged"))
        with pytest.raises(GoneError, match="unplugged"):
            await taking
    with pytest.raises(LocalProtocolError, match="not open"):
        await take()


async def test_function_that_takes_pictures_is_used_unchanged() -> None:
    async def take() -> Any:
        return GREY

    assert picture_taker(take) is take
