"""Scenarios: emulated cameras as data; files of them are read by :mod:`.scenario_file`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeVar

from pydantic import Field, field_validator, model_validator

from smartcam.emulator._application import BUILTIN_APPLICATIONS, Application
from smartcam.emulator._bvs.quirks import Quirks
from smartcam.emulator._data import EmulatorData
from smartcam.emulator._scenario.timeline import Cue
from smartcam.emulator.faults._matching import misfit
from smartcam.exceptions import ConfigurationError
from smartcam.protocols._bvs import BVS

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_CUES = 1000
"""Cues of a timeline; every state that a camera enters is compared with those that wait for one."""


T = TypeVar("T")

_SHOWN = 20  # ids that an error names


class Scenario(EmulatorData):
    """One camera: its applications, how it stands at first, its quirks, and what happens to it."""

    name: str = Field(default="camera", min_length=1, max_length=200, description="for logs")
    dialect: str = Field(default="handbook", description="name of the wire dialect")
    transport: Literal["tcp", "udp"] = Field(default="tcp", description="tcp or udp")
    port: int = Field(default=0, ge=0, le=65_535, description="port; 0 takes a free one")
    applications: tuple[Application, ...] = Field(
        default=(), description="the programs stored on it"
    )
    active: int | None = Field(
        default=None,
        description="id of the one loaded at first; default the first of applications, else 1",
    )
    running: bool = Field(default=False, description="in run mode from the beginning")
    builtins: bool = Field(
        default=True, description="have the built-in applications, as far as their ids are free"
    )
    quirks: Quirks = Field(default=Quirks(), description="what is unknown of real cameras")
    seed: int = Field(
        default=0, description="of all that is left to chance: the scene's noise, the timeline"
    )
    timeline: tuple[Cue, ...] = Field(
        default=(), max_length=MAX_CUES, description="what happens to it by itself, and when"
    )

    @field_validator("dialect")
    @classmethod
    def _check_dialect(cls, value: str) -> str:
        if value not in BVS.dialects:
            raise ValueError(f"unknown; known are {', '.join(BVS.dialects)}")
        return value

    @model_validator(mode="after")
    def _check(self) -> Scenario:
        ids = [application.id for application in self.applications]
        twice = _first_double(ids)
        if twice is not None:
            raise ValueError(f"application id {twice} is there twice")
        return self

    @property
    def all_applications(self) -> tuple[Application, ...]:
        """The scenario's applications, then the built-in ones whose ids are free."""
        ids = {application.id for application in self.applications}
        builtins = BUILTIN_APPLICATIONS if self.builtins else ()
        return (*self.applications, *(app for app in builtins if app.id not in ids))

    @property
    def commands(self) -> tuple[str, ...]:
        """The commands of the timeline, sorted."""
        return tuple(sorted({cue.command for cue in self.timeline if cue.command is not None}))

    @property
    def is_random(self) -> bool:
        """Whether chance has a part in the timeline."""
        return any(cue.is_random for cue in self.timeline)

    def mistake(self) -> tuple[tuple[str | int, ...], str] | None:
        """Return the place in it of what the camera cannot do, and why; None where all is well."""
        dialect = BVS.dialects[self.dialect]
        known = [application.id for application in self.all_applications]
        for number, application in enumerate(self.applications):
            ids = dialect.application_ids
            if application.id not in ids:
                text = (
                    f"application id {application.id} does not fit dialect {dialect.name}: "
                    f"{ids.start} to {ids.stop - 1}"
                )
                return ("applications", number, "id"), text
        if self.active is not None and self.active not in known:
            there = ", ".join(str(number) for number in known[:_SHOWN])
            more = ", ..." if len(known) > _SHOWN else ""
            asked = f"the id {self.active}" if self.active.bit_length() < 64 else "such an id"
            return ("active",), f"no application has {asked}; there are {there}{more}"
        try:
            spoken = dialect.with_quirks(self.quirks.of_the_wire)
        except ConfigurationError as exc:
            return ("quirks",), str(exc)
        for number, cue in enumerate(self.timeline):
            for place, fault in enumerate(cue.do):
                found = misfit(fault, spoken, known)
                if found is not None:
                    return ("timeline", number, "do", place, found[0]), found[1]
        return None


class ScenarioFile(Scenario):
    """A scenario file: one camera, or what several have in common, and these."""

    cameras: tuple[Scenario, ...] = Field(
        default=(),
        max_length=1000,
        description=(
            "several cameras: what stands beside this is what they have in common, and each adds "
            "its own or puts it in the place of that"
        ),
    )

    @model_validator(mode="after")
    def _check_cameras(self) -> ScenarioFile:
        if self.cameras and "port" in self.model_fields_set:
            raise ValueError("port: with several cameras each has its own")
        names = [camera.name for camera in self.each()]
        twice = _first_double(names)
        if twice is not None:
            raise ValueError(f"two cameras are called {twice!r}")
        return self

    def each(self) -> tuple[Scenario, ...]:
        """Return the cameras, each with what it has in common with the others."""
        common = {name: getattr(self, name) for name in self.model_fields_set - {"cameras"}}
        if not self.cameras:
            return (Scenario(**common),)
        return tuple(
            self._merged(index, camera, common) for index, camera in enumerate(self.cameras)
        )

    def _merged(self, index: int, camera: Scenario, common: dict[str, Any]) -> Scenario:
        own = {name: getattr(camera, name) for name in camera.model_fields_set}
        ids = {application.id for application in camera.applications}
        quirks = {name: getattr(camera.quirks, name) for name in camera.quirks.model_fields_set}
        merged = {
            **common,
            "name": f"camera{index + 1}",
            "seed": self.seed + index,
            **own,
            "applications": (
                *camera.applications,
                *(app for app in self.applications if app.id not in ids),
            ),
            "quirks": self.quirks.model_copy(update=quirks),
            "timeline": (*self.timeline, *camera.timeline),
        }
        return Scenario(**merged)

    def place(self, index: int, place: tuple[str | int, ...]) -> tuple[str | int, ...]:
        """Return the place in the file of something of a camera."""
        if not self.cameras:
            return place
        camera = self.cameras[index]
        name, *rest = place
        if name == "timeline" and isinstance(rest[0], int):
            own = rest[0] - len(self.timeline)
            return place if own < 0 else ("cameras", index, name, own, *rest[1:])
        if name == "applications" and isinstance(rest[0], int):
            own = rest[0] - len(camera.applications)
            return ("cameras", index, *place) if own < 0 else (name, own, *rest[1:])
        return ("cameras", index, *place) if name in camera.model_fields_set else place


def _first_double(values: Iterable[T]) -> T | None:
    """Return the first value that was there before; None where there is none."""
    seen: set[T] = set()
    for value in values:
        if value in seen:
            return value
        seen.add(value)
    return None
