"""Software cameras: programs on a source of frames, used by clients as a smart camera."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import socket
import sys
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import pytest

import smartcam
from smartcam import Status
from smartcam.emulator import EmulatedCamera
from smartcam.emulator._inside import InspectionOrder
from smartcam.exceptions import (
    CameraFaultError,
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    InspectionError,
    NotRunningError,
    OvertriggeredError,
    ResponseTimeoutError,
    UnsupportedError,
)
from smartcam.frames import find_format
from smartcam.inspection import Picture, SoftwareCamera, SoftwareDevice, load_cell
from smartcam.inspection._inside import judged_source
from tests.handmade import PATIENCE, until
from tests.inspection.seeing import Desk, DeskDriver, Gate, Level, cell_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from smartcam.emulator._inside import Inspector

pytestmark = pytest.mark.real_time

LIMITS: dict[str, Any] = {"connect_timeout": PATIENCE, "switch_timeout": PATIENCE}


@pytest.fixture
def desk(request: pytest.FixtureRequest) -> Desk:
    return Desk(f"d{abs(hash(request.node.nodeid)):x}")


@pytest.fixture
def gate() -> Gate:
    return Gate("gate")


@pytest.fixture
def cell(tmp_path: Path, desk: Desk) -> Path:
    return cell_of(tmp_path, desk)


@contextlib.asynccontextmanager
async def opened(cell: Path, **options: Any) -> AsyncIterator[SoftwareCamera[Any]]:
    """Open a software camera in this process."""
    async with smartcam.connect(f"software:{cell}#line1/cam1", **{**LIMITS, **options}) as camera:
        assert isinstance(camera, SoftwareCamera)
        yield camera


async def triggered(camera: smartcam.Camera[Any], **options: Any) -> Any:
    """Return the value of a trigger's result."""
    return (await camera.trigger(timeout=PATIENCE, **options)).value


# ---------------------------------------------------------------------- in the process


async def test_results_are_typed_by_the_program_without_interpret_as(
    cell: Path, desk: Desk
) -> None:
    async with opened(cell) as camera:
        desk.level = 42
        found = await triggered(camera)
        assert (found.ok, found.reason, found.level) == (True, "", 42)
        desk.level = 201
        found = await triggered(camera)
        assert (found.ok, found.reason, found.level) == (False, "201 is too bright", 201)


async def test_threads_take_turns_more_often_while_tools_are_at_work(
    cell: Path, gate: Gate
) -> None:
    before = sys.getswitchinterval()
    async with opened(cell) as camera:
        for _ in range(20):  # what the interpreter cuts off does not add up
            await triggered(camera)
        assert sys.getswitchinterval() == pytest.approx(before, abs=3e-6)
        await camera.switch_application(12)
        trigger = asyncio.ensure_future(triggered(camera))
        await until(lambda: gate.has(1))
        assert sys.getswitchinterval() == pytest.approx(min(before, 0.001), abs=3e-6)
        gate.open.set()
        await trigger
        assert sys.getswitchinterval() == pytest.approx(before, abs=3e-6)


async def test_the_camera_runs_its_first_application_from_the_beginning(cell: Path) -> None:
    async with opened(cell) as camera:
        assert camera.active_application == 7
        assert camera.status & Status.RUNNING


async def test_an_older_frame_than_the_trigger_is_never_judged(cell: Path, desk: Desk) -> None:
    async with opened(cell) as camera:
        desk.streams = False
        trigger = asyncio.ensure_future(triggered(camera))
        await until(lambda: camera.status & Status.BUSY)
        desk.show(10, age=1.0)  # exposed before, and on the way until now
        await asyncio.sleep(0.05)
        assert not trigger.done()
        desk.show(30)
        assert (await trigger).level == 30


async def test_applications_are_switched_by_number_and_by_name(cell: Path, desk: Desk) -> None:
    async with opened(cell) as camera:
        await camera.switch_application(40)
        first = await camera.trigger(timeout=PATIENCE)
        second = await camera.trigger(timeout=PATIENCE)
        assert (first.application, second.application) == (40, 40)
        assert second.sequence != first.sequence
        await camera.switch_application("bright")
        assert (await camera.trigger(timeout=PATIENCE)).application == 7
        with pytest.raises(ConfigurationError, match=r"no application 'dark'.*7 \(bright\)"):
            await camera.switch_application("dark")
        counted = await camera.trigger(application="counted", timeout=PATIENCE)
        assert (counted.application, camera.active_application) == (40, 7)
        with pytest.raises(ConfigurationError, match="'dark' is none of bright, gated"):
            await camera.trigger(application="dark")
    async with opened(cell, application="counted") as camera:
        assert (await camera.trigger(timeout=PATIENCE)).application == 40
    with pytest.raises(ConfigurationError, match="'dark' is none of bright, gated"):
        smartcam.connect(f"software:{cell}#line1/cam1", application="dark")


async def test_a_slow_program_is_busy_and_a_trigger_meanwhile_overtriggered(
    cell: Path, desk: Desk, gate: Gate
) -> None:
    device = SoftwareDevice(load_cell(cell)["line1/cam1"])
    async with device, smartcam.connect(device.url, application=12, **LIMITS) as camera:
        trigger = asyncio.ensure_future(camera.trigger(timeout=PATIENCE))
        await until(lambda: gate.reached)
        assert camera.status & Status.BUSY
        assert not camera.status & Status.WAITING_FOR_TRIGGER
        await camera.request(0x40, b"")  # what a client with no patience sends
        with pytest.raises(OvertriggeredError):
            await trigger
        assert camera.status & Status.BUSY
        gate.open.set()
        await camera.wait_status(lambda status: not status & Status.BUSY, timeout=PATIENCE)
        assert gate.reached == 1
        assert (await camera.trigger(timeout=PATIENCE)).application == 12


async def test_a_lost_source_is_a_system_error_until_it_is_back(cell: Path, desk: Desk) -> None:
    async with opened(cell) as camera:
        await triggered(camera)
        desk.unplug()
        await camera.wait_status(
            lambda status: bool(status & Status.SYSTEM_ERROR), timeout=PATIENCE
        )
        with pytest.raises(CameraFaultError, match=r"System Error: .*cable"):
            await triggered(camera)
        desk.plug()
        desk.level = 77
        await camera.wait_status(lambda status: not status & Status.SYSTEM_ERROR, timeout=PATIENCE)
        assert (await triggered(camera)).level == 77


async def test_source_lost_during_a_trigger_ends_the_trigger(cell: Path, desk: Desk) -> None:
    async with opened(cell) as camera:
        desk.streams = False
        trigger = asyncio.ensure_future(triggered(camera))
        await until(lambda: camera.status & Status.BUSY)
        desk.unplug()
        with pytest.raises(CameraFaultError):
            await trigger


async def test_missing_source_is_a_system_error_until_it_comes(cell: Path, desk: Desk) -> None:
    desk.unplug()
    async with opened(cell) as camera:
        assert camera.status & Status.SYSTEM_ERROR
        with pytest.raises(CameraFaultError):
            await triggered(camera)
        desk.plug()
        await camera.wait_status(lambda status: not status & Status.SYSTEM_ERROR, timeout=PATIENCE)
        assert (await triggered(camera)).level == desk.level


@contextlib.asynccontextmanager
async def stopped_run(cell: Path, gate: Gate) -> AsyncIterator[smartcam.Camera]:
    """Give a camera that was stopped during a run, whose tool still works."""
    device = SoftwareDevice(load_cell(cell)["line1/cam1"])
    layouts = device.interpret_as
    async with (
        device,
        smartcam.connect(device.url, application=12, interpret_as=layouts, **LIMITS) as camera,
    ):
        trigger = asyncio.ensure_future(triggered(camera))
        await until(lambda: gate.reached)
        device.emulator.device.stop()  # by the camera's own pages
        with pytest.raises(NotRunningError):
            await trigger
        yield camera


async def test_a_stopped_run_never_answers_a_later_trigger(
    cell: Path, desk: Desk, gate: Gate
) -> None:
    desk.level = 1
    async with stopped_run(cell, gate) as camera:
        desk.level = 2
        await camera.start()
        new = asyncio.ensure_future(triggered(camera))
        await until(lambda: camera.status & Status.BUSY)
        gate.open.set()
        assert (await new).level == 2


async def test_a_cancelled_trigger_leaves_a_working_camera(
    cell: Path, desk: Desk, gate: Gate
) -> None:
    async with opened(cell, application=12) as camera:
        desk.level = 1
        trigger = asyncio.ensure_future(triggered(camera))
        await until(lambda: gate.reached)
        trigger.cancel()
        with pytest.raises(asyncio.CancelledError):
            await trigger
        desk.level = 2
        gate.open.set()
        await camera.wait_status(lambda status: not status & Status.BUSY, timeout=PATIENCE)
        assert (await triggered(camera)).level == 2


async def test_faulty_tool_gives_a_result_that_is_not_ok_with_a_reason(cell: Path) -> None:
    async with opened(cell, application=20) as camera:
        found = await triggered(camera)
        assert not found.ok
        assert "level failed" in found.reason
        assert found.level == 0


def inspector_of(device: SoftwareDevice) -> Inspector:
    emulated: Any = device.emulator.device
    return (
        device.inspector if isinstance(device.emulator, EmulatedCamera) else emulated.job.inspector
    )


@pytest.mark.parametrize("protocol", ["bvs", "insight"])
async def test_a_fault_with_a_text_that_no_result_can_hold_ends_its_run(
    cell: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    protocol: str,
) -> None:
    caplog.set_level(logging.CRITICAL, logger="smartcam")  # such a text cannot go between workers

    def fault(*_: Any) -> None:
        raise InspectionError("m\udce4rz\0bin", application=7, tool="level")

    monkeypatch.setattr(Level, "inspect", fault)
    device = SoftwareDevice(load_cell(cell)["line1/cam1"], protocol=protocol)
    async with device:
        ended: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        inspector_of(device).begin(InspectionOrder(7, 1, b""), lambda: None, ended.set_result)
        async with asyncio.timeout(PATIENCE):
            found = await ended
        assert not found["ok"]
        assert "m?rz?bin" in found["reason"]


@pytest.mark.parametrize("protocol", ["bvs", "insight"])
async def test_values_that_cannot_be_built_end_their_run_without_a_result(
    cell: Path, monkeypatch: pytest.MonkeyPatch, protocol: str
) -> None:
    where = "frame_inspector.failed_values" if protocol == "bvs" else "device._as_mapping"
    monkeypatch.setattr(f"smartcam.inspection._camera.{where}", lambda *_: 1 / 0)
    device = SoftwareDevice(load_cell(cell)["line1/cam1"], protocol=protocol)
    async with device:
        ended: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        inspector_of(device).begin(InspectionOrder(20, 1, b""), lambda: None, ended.set_result)
        async with asyncio.timeout(PATIENCE):
            assert await ended is None


async def test_tools_that_do_not_end_give_a_result_and_keep_no_later_trigger(
    cell: Path, desk: Desk, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.inspection._camera.frame_inspector.TOOLS_TIMEOUT", 0.3)
    async with opened(cell, application=12) as camera:
        found = await triggered(camera)
        assert not found.ok
        assert "did not end within 0.3 s" in found.reason
        await camera.switch_application(7)
        desk.level = 5
        assert (await triggered(camera)).level == 5
        gate.open.set()


async def test_cancelled_run_with_a_working_tool_does_not_delay_later_runs(
    cell: Path, desk: Desk, gate: Gate
) -> None:
    async with stopped_run(cell, gate) as camera:
        await camera.switch_application(7)
        await camera.start()
        desk.level = 5
        assert (await triggered(camera)).level == 5
        gate.open.set()


async def test_given_up_tools_have_a_bounded_number_of_threads(
    cell: Path, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.inspection._camera.frame_inspector.MAX_HUNG_THREADS", 2)
    device = SoftwareDevice(load_cell(cell)["line1/cam1"])
    async with device:
        inspector = device.inspector
        for number in range(5):
            seen = asyncio.Event()
            inspector.begin(InspectionOrder(12, number, b""), seen.set, lambda _: None)
            await seen.wait()
            await until(partial(gate.has, min(number + 1, 3)))
        gate.open.set()
        ended: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        inspector.begin(InspectionOrder(7, 5, b""), lambda: None, ended.set_result)
        async with asyncio.timeout(PATIENCE):
            assert (await ended)["ok"]
        assert gate.reached == 3  # the others were cancelled before they began


HANGS = """
import asyncio, sys, threading
import smartcam
from smartcam.inspection import Tool, ToolSettings, register_tool

class Hang(Tool):
    settings_model = ToolSettings

    def inspect(self, view):
        threading.Event().wait()

register_tool("hang", Hang)

async def main():
    async with smartcam.connect(f"software:{sys.argv[1]}") as camera:
        try:
            await camera.trigger(timeout=0.5)
        except smartcam.TriggerTimeoutError:
            print("closing")

asyncio.run(main())
"""


async def test_a_tool_that_hangs_keeps_no_process_from_its_end(tmp_path: Path) -> None:
    cv2: Any = pytest.importorskip("cv2")
    np: Any = pytest.importorskip("numpy")
    pytest.importorskip("av")
    assert cv2.imwrite(str(tmp_path / "p.png"), np.zeros((20, 20), np.uint8))
    cell = tmp_path / "cell.yaml"
    cell.write_text("cameras: {c: {software: {frames: p.png, applications: {1: {hang: {}}}}}}\n")
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", HANGS, str(cell), stdout=asyncio.subprocess.PIPE
    )
    try:
        async with asyncio.timeout(PATIENCE):
            said, _ = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    assert (process.returncode, said.split()) == (0, [b"closing"])


async def test_a_driver_with_a_fault_is_a_lost_source(
    cell: Path, desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with opened(cell) as camera:
        monkeypatch.setattr(DeskDriver, "open", lambda _: 1 / 0)
        desk.unplug()
        await until(lambda: "ZeroDivisionError" in camera.frame_trouble)
        with pytest.raises(CameraFaultError):
            await triggered(camera)
        monkeypatch.undo()
        desk.plug()
        await camera.wait_status(lambda status: not status & Status.SYSTEM_ERROR, timeout=PATIENCE)
        assert (await triggered(camera)).level == desk.level


async def test_input_data_reaches_the_tools_of_its_trigger(cell: Path) -> None:
    async with opened(cell) as camera:
        assert (await triggered(camera, input=b"first")).input == "first"
        assert (await triggered(camera, input=b"next")).input == "next"


async def test_the_picture_that_was_judged_can_be_read_with_its_result(
    cell: Path, desk: Desk
) -> None:
    cv2: Any = pytest.importorskip("cv2")
    np: Any = pytest.importorskip("numpy")

    def pixels(data: bytes, how: int) -> Any:
        return cv2.imdecode(np.frombuffer(data, np.uint8), how)

    async with opened(cell) as camera:
        with pytest.raises(UnsupportedError, match="no picture was judged yet"):
            await camera.read_image()
        desk.level = 33
        assert (await triggered(camera)).level == 33
        desk.level = 99
        await asyncio.sleep(0.05)
        plain = pixels(await camera.read_image(), cv2.IMREAD_UNCHANGED)
        assert plain.shape == (48, 64)
        assert (plain == 33).all()
        drawn = pixels(await camera.read_drawn_image(), cv2.IMREAD_UNCHANGED)
        assert drawn.shape == (48, 64, 3)
        assert (drawn != 33).any()


@pytest.mark.parametrize(
    ("name", "level", "kept"),
    [
        *(("Mono10", 0, 0), ("Mono10", 512, 0x8020), ("Mono10", 1023, 0xFFFF)),
        *(("Mono12", 0x234, 0x2342), ("Mono12", 4095, 0xFFFF), ("Mono16", 0x1234, 0x1234)),
    ],
)
async def test_picture_of_more_bits_keeps_its_brightness_in_its_file(
    tmp_path: Path, desk: Desk, name: str, level: int, kept: int
) -> None:
    desk.format, desk.level = find_format(name), level
    async with opened(cell_of(tmp_path, desk)) as camera:
        judged = (await triggered(camera)).level
        file = tmp_path / "read.png"
        file.write_bytes(await camera.read_image())
    picture = Picture.read(file)
    assert (picture.grey == judged).all()
    assert (picture.depth, picture.size) == (16, (64, 48))
    assert (picture.levels == kept).all()  # white is white to what asks whether it is cut off


async def test_picture_not_made_in_time_is_a_typed_error(cell: Path) -> None:
    async with opened(cell) as camera:
        await triggered(camera)
        for read in (camera.read_image, camera.read_drawn_image):
            with pytest.raises(ResponseTimeoutError, match="not made within 1e-09 s"):
                await read(timeout=1e-9)


async def test_bad_pictures_are_kept_with_findings_and_the_oldest_are_deleted(
    tmp_path: Path, desk: Desk
) -> None:
    cv2: Any = pytest.importorskip("cv2")
    path = cell_of(tmp_path, desk, "keep: {folder: kept, most: 2}")
    async with opened(path) as camera:
        for level in (10, 210, 220, 230):
            desk.level = level
            assert (await triggered(camera)).level == level
    kept = await asyncio.to_thread(lambda: sorted((tmp_path / "kept").iterdir()))
    assert [one.suffix for one in kept] == [".json", ".png"] * 2
    said = [json.loads(one.read_text()) for one in kept[::2]]
    assert [one["value"]["level"] for one in said] == [220, 230]
    assert [one["ok"] for one in said] == [False, False]
    assert [cv2.imread(str(one), cv2.IMREAD_UNCHANGED)[0, 0] for one in kept[1::2]] == [220, 230]


async def test_a_camera_deletes_no_picture_but_its_own(tmp_path: Path, desk: Desk) -> None:
    path = cell_of(tmp_path, desk, "keep: {folder: kept, which: all, most: 1}")
    kept = tmp_path / "kept"
    kept.mkdir()
    others = [
        "2025-golden-sample-part-7.png",
        "20250101-000000-000000-line1-cam10-7-ok.png",
        "20250101-000000-000000-line1-cam1-7-ok.json",
    ]
    for name in others:
        (kept / name).write_text("another's")
    async with opened(path) as camera:
        for _ in range(2):
            await triggered(camera)
    names = {one.name for one in await asyncio.to_thread(lambda: list(kept.iterdir()))}
    assert names > set(others)
    assert [name[22:] for name in names - set(others)].count("-line1-cam1-7-ok.png") == 1


def test_a_folder_for_pictures_with_a_zero_is_refused(tmp_path: Path, desk: Desk) -> None:
    with pytest.raises(ConfigurationError, match=r"keep.folder: .*without a NUL"):
        load_cell(cell_of(tmp_path, desk, r'keep: {folder: "a\0b"}'))


async def test_a_folder_that_cannot_be_written_costs_the_pictures_alone(
    tmp_path: Path, desk: Desk
) -> None:
    path = cell_of(tmp_path, desk, "keep: {folder: kept, which: all}")
    (tmp_path / "kept").write_text("no folder")
    async with opened(path) as camera:
        for _ in range(3):
            assert (await triggered(camera)).ok


async def test_a_free_running_application_sends_results_by_itself(cell: Path, desk: Desk) -> None:
    async with opened(cell, application=30) as camera:
        results = camera.results()
        first = await anext(results)
        desk.level = 55
        async with asyncio.timeout(PATIENCE):
            async for result in results:
                if result.value.level == 55:
                    break
        assert result.number > first.number
        await camera.stop()
        results.close()


async def test_closing_amid_an_inspection_ends_everything(
    cell: Path, desk: Desk, gate: Gate
) -> None:
    async with opened(cell, application=12) as camera:
        trigger = asyncio.ensure_future(triggered(camera))
        await until(lambda: gate.reached)
        asyncio.get_running_loop().call_later(0.1, gate.open.set)
    with pytest.raises(smartcam.SmartCamError):
        await trigger
    assert desk.sink is None


async def test_cancelled_opening_closes_the_source(cell: Path, desk: Desk) -> None:
    desk.streams = False
    camera = smartcam.connect(f"software:{cell}")
    opening = asyncio.ensure_future(camera.open())
    await until(lambda: desk.sink is not None)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert desk.sink is None
    await camera.close()


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("software:", "expected software:FILE#CAMERA"),
        ("software:{cell}#line2", "no software camera 'line2'; it has line1/cam1"),
        ("software:{cell}.not", "cannot be read|No such file|not found|does not exist"),
    ],
)
def test_wrong_address_is_refused_with_known_cameras(cell: Path, address: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        smartcam.connect(address.format(cell=cell))


def test_software_address_is_no_network_address(cell: Path) -> None:
    with pytest.raises(UnsupportedError, match="smartcam-emulator --program"):
        smartcam.settings.parse_address(f"software:{cell}")


# ---------------------------------------------------------------------- its judged pictures


@pytest.mark.parametrize("error", [FrameFormatError("cut off"), ZeroDivisionError()])
async def test_a_damaged_picture_is_lost_and_any_other_fault_ends_the_pictures(
    cell: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    device = SoftwareDevice(load_cell(cell)["line1/cam1"])
    left = [error]

    def drawn(_: Any) -> None:
        monkeypatch.undo()
        raise left.pop()

    monkeypatch.setattr("smartcam.inspection._camera.judged_frames._draw_marks", drawn)
    async with (
        device,
        smartcam.connect(device.url, application=7, **LIMITS) as camera,
        judged_source(device.inspector, drawn=True) as source,
        source.reader(timeout=PATIENCE) as reader,
    ):
        await camera.trigger(timeout=PATIENCE)
        await until(lambda: not left)
        await camera.trigger(timeout=PATIENCE)
        if isinstance(error, smartcam.SmartCamError):
            await anext(reader)
            assert reader.statistics().lost == 1
        else:
            with pytest.raises(FrameSourceError, match="ZeroDivisionError"):
                await anext(reader)


# ---------------------------------------------------------------------- on the wire


@pytest.mark.parametrize("transport", ["tcp", "udp"])
@pytest.mark.parametrize("dialect", ["handbook", "thesis", "b16", "bid"])
async def test_clients_of_every_dialect_get_its_results(
    cell: Path, desk: Desk, dialect: str, transport: Literal["tcp", "udp"]
) -> None:
    device = SoftwareDevice(load_cell(cell)["line1/cam1"], dialect=dialect, transport=transport)
    async with device:
        layouts = device.interpret_as
        async with smartcam.connect(
            device.url, application=7, interpret_as=layouts, **LIMITS
        ) as camera:
            for level in (3, 250):
                desk.level = level
                found = await triggered(camera)
                assert (found.ok, found.level) == (level <= 200, level)
            await camera.switch_application(40)
            assert (await camera.trigger(timeout=PATIENCE)).value.level == 250


async def test_a_plain_socket_gets_a_result_to_the_bytes_of_the_manual(
    cell: Path, desk: Desk
) -> None:
    device = SoftwareDevice(load_cell(cell)["line1/cam1"], dialect="b16")
    desk.level = 9
    async with device:
        reader, writer = await asyncio.open_connection("127.0.0.1", device.emulator.port)
        writer.write(bytes.fromhex("01000000"))  # Connect
        async with asyncio.timeout(PATIENCE):
            await reader.readexactly(4 + 2)  # its answer, protocol version
            await reader.readexactly(4 + 2)  # status
            writer.write(bytes.fromhex("40000000"))  # Trigger
            while True:
                head = await reader.readexactly(4)
                number, size = head[0] + 256 * head[1], head[2] + 256 * head[3]
                body = await reader.readexactly(size)
                if number == 0x20:
                    break
        assert body[:2] == (7).to_bytes(2, "little")
        assert body[2] == 0xFF  # ok
        assert int.from_bytes(body[2 + 1 + 80 :][:4], "little") == 9
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def test_an_insight_client_reads_cells_and_the_judged_picture(cell: Path, desk: Desk) -> None:
    device = SoftwareDevice(load_cell(cell)["line1/cam1"], protocol="insight")
    desk.level = 21
    async with device:
        layout = "ok: bool, level: int32, angle: real32 deg"
        async with smartcam.connect(
            f"{device.url}?cells=ok,level,angle", interpret_as=layout, **LIMITS
        ) as camera:
            found = await triggered(camera)
            assert (found.ok, found.level) == (True, 21)
            assert found.angle == pytest.approx(math.pi / 2)  # 90.000 in its cell
            data = await camera.read_image(timeout=PATIENCE)
            assert data[:2] == b"BM"
            assert data[-8:] == bytes([21]) * 8
            await camera.switch_application(40)
            desk.level = 22
            assert (await triggered(camera)).level == 22
            desk.unplug()
            await until(lambda: device.inspector.trouble)
            with pytest.raises(smartcam.SmartCamError):
                await triggered(camera)
            desk.plug()
            await until(lambda: not device.inspector.trouble)
            assert (await triggered(camera)).level == 22


async def test_a_second_client_takes_the_camera_over(cell: Path, desk: Desk) -> None:
    device = SoftwareDevice(load_cell(cell)["line1/cam1"])
    async with device:
        first = smartcam.connect(device.url, reconnect=None, **LIMITS)
        async with first, smartcam.connect(device.url, **LIMITS) as second:
            assert (await second.trigger(timeout=PATIENCE)).application == 7
            await until(lambda: not first.connected)


async def test_occupied_port_closes_the_source(cell: Path, desk: Desk) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        device = SoftwareDevice(load_cell(cell)["line1/cam1"], port=port)
        with pytest.raises(ConfigurationError, match="cannot listen"):
            await device.start()
    assert desk.sink is None
