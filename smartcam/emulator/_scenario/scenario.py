"""Scenarios: emulated cameras as data; ``file.py`` reads files of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

from pydantic import Field, ValidationInfo, field_validator, model_validator

from smartcam.emulator._application import BUILTIN_APPLICATIONS, Application
from smartcam.emulator._bvs.quirks import Quirks
from smartcam.emulator._data import EmulatorData
from smartcam.emulator._scenario.timeline import Cue
from smartcam.exceptions import ConfigurationError, UnsupportedError
from smartcam.protocols import BVS
from smartcam.protocols._inside import HANDBOOK, load_protocol

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_CUES = 1000
"""Largest number of cues of a timeline; each state that a camera enters is compared with them."""


T = TypeVar("T")

Mistake: TypeAlias = tuple[tuple[str | int, ...], str]
"""The path of the field with a mistake in a scenario, and the reason."""


class Scenario(EmulatorData):
    """One camera: its applications, its first state, its quirks, and its timeline."""

    name: str = Field(default="camera", min_length=1, max_length=200, description="name in logs")
    protocol: str = Field(
        default=BVS.name, description="name of the protocol; others than bvs take options"
    )
    dialect: str = Field(
        default=HANDBOOK.name,
        description="name of the wire dialect; default handbook for bvs, else the first one",
    )
    transport: Literal["tcp", "udp"] = Field(default="tcp", description="tcp or udp")
    port: int = Field(default=0, ge=0, le=65_535, description="port; 0 takes a free one")
    applications: tuple[Application, ...] = Field(
        default=(), description="the programs stored on it"
    )
    active: int | None = Field(
        default=None,
        description="id of the one loaded at first; default the first of applications, else 1",
    )
    running: bool = Field(default=False, description="camera is in run mode from the beginning")
    builtins: bool = Field(
        default=True, description="have the built-in applications, as far as their ids are free"
    )
    quirks: Quirks = Field(default=Quirks(), description="unknown behaviour of real cameras")
    seed: int = Field(default=0, description="seed of all chance: the scene's noise, the timeline")
    timeline: tuple[Cue, ...] = Field(
        default=(),
        max_length=MAX_CUES,
        description="events of the camera, and their times",
    )

    options: dict[str, Any] = Field(
        default_factory=dict[str, Any],
        description="options of the emulated camera of another protocol than bvs",
    )

    @field_validator("dialect")
    @classmethod
    def _check_dialect(cls, value: str, info: ValidationInfo) -> str:
        try:
            known = load_protocol(info.data.get("protocol", BVS.name)).dialects
        except ConfigurationError:
            return value  # the protocol's own check reports it
        if value not in known:
            raise ValueError(f"unknown; known are {', '.join(known)}")
        return value

    @model_validator(mode="after")
    def _check(self) -> Scenario:
        ids = [application.id for application in self.applications]
        duplicate = _first_duplicate(ids)
        if duplicate is not None:
            raise ValueError(f"application id {duplicate} is there twice")
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
        """True if the timeline depends on chance."""
        return any(cue.is_random for cue in self.timeline)

    def mistake(self) -> Mistake | None:
        """Return the path of a field that the camera cannot do, and the reason; or None."""
        from smartcam.emulator._makes import emulated_class  # that module imports this one

        try:
            camera_class = emulated_class(self.protocol)
        except (ConfigurationError, UnsupportedError) as exc:
            return ("protocol",), str(exc)
        return camera_class.mistake(self)

    def changed(self) -> set[str]:
        """Return the names of the fields that have another value than their default."""
        fields = type(self).model_fields
        return {
            name
            for name, field in fields.items()
            if getattr(self, name) != field.get_default(call_default_factory=True)
        }


class ScenarioFile(Scenario):
    """A scenario file: one camera, or several with their common fields."""

    cameras: tuple[Scenario, ...] = Field(
        default=(),
        max_length=1000,
        description=(
            "several cameras: the fields beside this one are common to all, and each camera adds "
            "its own fields, or replaces common ones"
        ),
    )

    @model_validator(mode="after")
    def _check_cameras(self) -> ScenarioFile:
        if self.cameras and "port" in self.model_fields_set:
            raise ValueError("port: with several cameras each has its own")
        names = [camera.name for camera in self.split_cameras()]
        duplicate = _first_duplicate(names)
        if duplicate is not None:
            raise ValueError(f"two cameras are called {duplicate!r}")
        return self

    def split_cameras(self) -> tuple[Scenario, ...]:
        """Return the cameras, each with the common fields."""
        common = {name: getattr(self, name) for name in self.model_fields_set - {"cameras"}}
        if not self.cameras:
            return (Scenario(**common),)
        return tuple(
            self._merged(index, camera, common) for index, camera in enumerate(self.cameras)
        )

    def _merged(self, index: int, camera: Scenario, common: dict[str, Any]) -> Scenario:
        own_fields = {name: getattr(camera, name) for name in camera.model_fields_set}
        ids = {application.id for application in camera.applications}
        quirks = {name: getattr(camera.quirks, name) for name in camera.quirks.model_fields_set}
        merged = {
            **common,
            "name": f"camera{index + 1}",
            "seed": self.seed + index,
            **own_fields,
            "applications": (
                *camera.applications,
                *(app for app in self.applications if app.id not in ids),
            ),
            "quirks": self.quirks.model_copy(update=quirks),
            "options": {**self.options, **camera.options},
            "timeline": (*self.timeline, *camera.timeline),
        }
        return Scenario(**merged)

    def path_in_file(self, index: int, path: tuple[str | int, ...]) -> tuple[str | int, ...]:
        """Return a field's path in the file; ``path``: its path in the camera ``index``."""
        if not self.cameras:
            return path
        camera = self.cameras[index]
        name, *inner = path
        if name == "timeline" and isinstance(inner[0], int):
            own_index = inner[0] - len(self.timeline)
            return path if own_index < 0 else ("cameras", index, name, own_index, *inner[1:])
        if name == "applications" and isinstance(inner[0], int):
            own_index = inner[0] - len(camera.applications)
            return ("cameras", index, *path) if own_index < 0 else (name, own_index, *inner[1:])
        return ("cameras", index, *path) if name in camera.model_fields_set else path


def _first_duplicate(values: Iterable[T]) -> T | None:
    """Return the first value that occurred before; None without one."""
    earlier_values: set[T] = set()
    for value in values:
        if value in earlier_values:
            return value
        earlier_values.add(value)
    return None
