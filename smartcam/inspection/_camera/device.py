"""Define the device of a software camera: an emulated camera that inspects real frames."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

from smartcam import frames
from smartcam._arguments import check_choice, check_kind, check_port
from smartcam._server import Server
from smartcam.emulator import EmulatedCamera, EmulatedInSight
from smartcam.emulator._inside import InspectedApplication, InspectedJob, Inspector
from smartcam.exceptions import ConfigurationError
from smartcam.inspection._camera.frame_inspector import FrameInspector
from smartcam.inspection._camera.keeper import PictureKeeper
from smartcam.inspection._cell import CellCamera
from smartcam.layout import Layout
from smartcam.models import Status
from smartcam.settings import validated

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.emulator import WireCamera
    from smartcam.emulator._inside import InspectionOrder, LastReport, Values
    from smartcam.frames import FrameSource
    from smartcam.inspection._program import Program

_log: Final = logging.getLogger("smartcam.inspection")

MAX_RECORDS: Final = 32
"""Largest number of records of a list that the cells of an In-Sight camera hold."""

NO_VALUE: Final = "#ERR"
"""Text of a cell without a value."""

_RECORDING_ADDRESS: Final = re.compile(r"^(?:[A-Za-z]:[\\/]|(?![A-Za-z][A-Za-z0-9+.-]*:)|file:)")


class SoftwareDevice(Server):
    """A device that inspects the frames of a source, with a smart camera's protocol.

    The device starts in run mode. While the source of frames is lost, the device reports System
    Error. During an inspection it reports BUSY; a trigger during this time is Overtriggered.

    Args:
        camera: programs of the camera, and the address of the frames.
        protocol: ``"bvs"`` or ``"insight"``.
        host: address to listen on.
        port: port to listen on, 0 for a free one.
        transport: ``"tcp"`` or ``"udp"``, of ``bvs``; default ``"tcp"``.
        dialect: name of the dialect of ``bvs``; default ``handbook``.
        quirks: options of the emulated camera for unknown behaviour of real cameras.
        seed: seed of the emulated camera's random numbers.

    Raises:
        ConfigurationError: an argument or the camera's file is wrong.

    Attributes:
        camera: programs of the camera, and the address of the frames.
        inspector: inspector of the frames.
        emulator: the device and its port.
    """

    def __init__(
        self,
        camera: CellCamera,
        *,
        protocol: str = "bvs",
        host: str = "127.0.0.1",
        port: int = 0,
        transport: Literal["tcp", "udp"] | None = None,
        dialect: str | None = None,
        quirks: dict[str, Any] | None = None,
        seed: int | None = None,
    ) -> None:
        self.camera: CellCamera = check_kind(
            camera, CellCamera, "camera", "a CellCamera", "SoftwareDevice"
        )
        protocol = check_choice(protocol, "protocol", ("bvs", "insight"), "SoftwareDevice")
        port = check_port(port, "SoftwareDevice")
        if quirks is not None:
            check_kind(quirks, Mapping, "quirks", "a mapping, or None", "SoftwareDevice")
        is_recording = _RECORDING_ADDRESS.match(camera.frames) is not None
        make_frames = partial(make_source, camera.frames, recorded=is_recording)
        make_frames()  # a wrong address raises its error now
        self.inspector: FrameInspector = FrameInspector(
            camera.name,
            make_frames,
            camera.programs,
            recorded=is_recording,
            grey=protocol == "insight",
            on_trouble=self._report_trouble,
        )
        self._keeper: PictureKeeper | None = None
        if camera.keep is not None:
            self._keeper = PictureKeeper(
                camera.name, camera.folder / camera.keep.folder, camera.keep
            )
            self.inspector.viewers.add(self._keeper.add_picture)
        self.emulator: WireCamera
        if protocol == "insight":
            for name, value in (("transport", transport), ("dialect", dialect)):
                if value not in {None, "tcp", "native"}:
                    raise ConfigurationError(f"{camera.name}: In-Sight has no {name} {value!r}")
            self.emulator = EmulatedInSight(
                jobs=[self._job(program) for program in camera.programs.values()],
                online=True,
                host=host,
                port=port,
                name=camera.name,
                quirks=quirks,
                seed=seed or 0,
            )
            self.emulator.device.get_last_image = self._last_picture
        else:
            self.emulator = EmulatedCamera(
                [self._application(program) for program in camera.programs.values()],
                builtins=False,
                running=True,
                host=host,
                port=port,
                transport=transport,
                dialect=dialect,
                name=camera.name,
                quirks={"busy_while_processing": True, **(quirks or {})},
                seed=seed,
            )

    def _application(self, program: Program) -> InspectedApplication:
        return validated(
            InspectedApplication,
            {
                "id": program.application,
                "name": program.name,
                "layout": program.layout.text,
                "rate": self.camera.rates.get(program.application),
                "processing_time": 0.0,
                "inspector": self.inspector,
            },
            f"{self.camera.name}: application {program.application}",
        )

    def _job(self, program: Program) -> InspectedJob:
        name = re.sub(r"[^A-Za-z0-9_-]", "_", program.name)
        number = str(program.application)
        return validated(
            InspectedJob,
            {
                "file": f"{number}{'' if name == number else name}.job",
                "cells": dict.fromkeys(cell_names(program), NO_VALUE),
                "rate": self.camera.rates.get(program.application),
                "load_time": 0.01,
                "inspector": _CellInspector(self.inspector, program),
                "application": program.application,
            },
            f"{self.camera.name}: application {program.application}",
        )

    @property
    def url(self) -> str:
        """Address of the device for clients."""
        return self.emulator.url

    @property
    def interpret_as(self) -> dict[int, str]:
        """Layout of the results of each application."""
        return {number: program.interpret_as for number, program in self.camera.programs.items()}

    def last_sent(self) -> tuple[int, LastReport | None]:
        """Return the session's number (0: no session), and the last report of a run.

        Only BVS cameras have reports: others send no containers.
        """
        device = self.emulator.device
        return (device.sessions if device.connected else 0), device.last_report

    async def start(self) -> None:
        """Open the source of the frames, then the port.

        If the source cannot be opened, the device starts with System Error.

        Raises:
            ConfigurationError: the device cannot listen on the port.

        Cancellation: leaves it stopped.
        """
        await self.inspector.start()
        if self._keeper is not None:
            self._keeper.start()
        try:
            await self.emulator.start()
        except BaseException:
            await self._stop_parts()
            raise

    async def stop(self) -> None:
        """Close the port and the source. Harmless when called twice.

        Cancellation: everything is closed nevertheless.
        """
        try:
            await self.emulator.stop()
        finally:
            await self._stop_parts()

    async def _stop_parts(self) -> None:
        """Stop the inspector and the keeper of pictures."""
        try:
            await self.inspector.stop()
        finally:
            if self._keeper is not None:
                await self._keeper.stop()

    def _report_trouble(self, trouble: str) -> None:
        device = self.emulator.device
        if isinstance(self.emulator, EmulatedInSight):
            device.set_blind(bool(trouble))
        else:
            device.set_condition(Status.SYSTEM_ERROR, bool(trouble))

    def _last_picture(self) -> Any:
        """Return the grey levels of the last inspected picture; a black pixel before the first."""
        import numpy as np

        inspected = self.inspector.last_picture
        if inspected is None or inspected.inspection is None:
            return np.zeros((1, 1), np.uint8)
        return inspected.inspection.picture.grey


class _CellInspector(Inspector):
    """Inspect frames, and convert a program's values to the units that In-Sight cells show.

    Args:
        inspector: inspector of the frames.
        program: program whose values are converted.
    """

    def __init__(self, inspector: FrameInspector, program: Program) -> None:
        self._inspector, self._layout = inspector, program.layout
        unitless = [str(replace(field, unit=None)) for field in program.layout.fields]
        if program.layout.repeat is None:
            text = ", ".join(unitless)
        else:
            name = next(step.name for step in program.steps if step.records)
            head = [str(replace(field, unit=None)) for field in program.layout.head]
            text = ", ".join([*head, f"{name}: ({', '.join(unitless)})*"])
        self._unitless_layout = Layout(text)

    def begin(
        self,
        order: InspectionOrder,
        on_exposed: Callable[[], None],
        on_done: Callable[[Values | None], None],
    ) -> None:
        """Start an inspection; ``on_done`` gets its values in the units of the layout."""
        number = None if self._layout.sequence_field is None else order.number & 0x7FFFFFFF

        def convert(found_values: Values | None) -> None:
            values: Values | None = None
            try:
                if found_values is not None:
                    data = self._layout.build(found_values, sequence=number)
                    values = _as_mapping(self._unitless_layout.parse(data))
            except Exception:  # noqa: BLE001 - the run has to end
                _log.exception("%s ! a result does not fit its cells", self._inspector.name)
            on_done(values)

        self._inspector.begin(order, on_exposed, convert)

    def cancel(self) -> None:
        """Cancel the running inspection."""
        self._inspector.cancel()


def _as_mapping(record: Any) -> dict[str, Any]:
    """Return a record with its nested records as mappings."""
    return {
        name: [_as_mapping(item) for item in value] if isinstance(value, list) else value
        for name, value in record._asdict().items()
    }


def make_source(address: str, *, recorded: bool) -> FrameSource:
    """Return the unopened source of an address; a recording is read as fast as runs need pictures.

    Raises:
        ConfigurationError: the address is wrong.
    """
    for name, value in (("pace", "none"), ("mixed", "yes")) if recorded else ():
        if re.search(rf"#(.*&)?{name}=", address) is None:
            mark = "&" if re.search(r"#\w+=[^#/]*$", address) else "#"
            address += f"{mark}{name}={value}"
    return frames.open(address)


def cell_names(program: Program) -> list[str]:
    """Return the names of the In-Sight cells that hold a program's values."""
    layout = program.layout
    if layout.repeat is None:
        return [field.name for field in layout.fields]
    names = [field.name for field in layout.head]
    for number in range(1, MAX_RECORDS + 1):
        names += [f"{field.name}_{number}" for field in layout.fields]
    return names
