"""Teach an application: try its tools on pictures, change them, and save them in their file.

Saving writes only values that have changed, and keeps the comments, order and quotes of the YAML.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, cast

from pydantic import ValidationError

from smartcam._arguments import (
    MAX_APPLICATION_ID,
    check_application_or_name,
    check_integer,
    check_path,
    check_text,
    wrong_argument,
)
from smartcam._extras import load
from smartcam._suggestions import did_you_mean
from smartcam._whole_files import replace_file
from smartcam.exceptions import ConfigurationError
from smartcam.inspection._cell import SoftwareEntry, make_camera
from smartcam.inspection._program import ProgramError
from smartcam.layout._inside import BadYamlError
from smartcam.layout._inside import load as load_yaml
from smartcam.registry import TOOLS

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.inspection._program import Program

MAX_FILE_BYTES: Final = 1 << 22
"""Largest size of a cell file (software cameras and their programs, in YAML), bytes."""

LINE_WIDTH: Final = 4096
"""Width, in characters, at which written lines are wrapped; large enough that no line is."""

NON_TOOL_KEYS: Final = ("name", "sequence", "rate")
"""Keys of an application that do not name tools."""


class Teaching:
    """Teach an application of a cell file.

    Args:
        path: the cell file, or a fleet file.
        camera: name of the software camera in the file.
        application: number or name of the application; saving adds one with a new number.

    Raises:
        ConfigurationError: the file cannot be read, or has no such software camera; the camera has
            no application of this name.
        MissingExtraError: the extra ``inspection`` is not installed.

    Attributes:
        path: the file.
        camera: name of the camera.
        application: number of the application.
        frames: address of the camera's frames.
    """

    def __init__(self, path: str | Path, camera: str, application: int | str) -> None:
        self.path: Path = check_path(path, "path", "Teaching")
        self.camera: str = check_text(camera, "camera", "Teaching")
        application = check_application_or_name(application, owner="Teaching")
        software = self._find_software(self._read_document())
        self.application: int = self._find_number(software["applications"], application)
        self.frames: str = SoftwareEntry.model_validate(software).frames_address(self.path.parent)
        stored = software["applications"].get(self.application, {})
        self._entry: dict[str, Any] = stored if isinstance(stored, dict) else {}

    @property
    def name(self) -> str:
        """Name of the application; its number if it has no name."""
        return str(self._entry.get("name") or self.application)

    @property
    def tools(self) -> dict[str, dict[str, Any]]:
        """Settings of the application's tools by their keys, as in the file."""
        return {
            key: dict(given or {}) for key, given in self._entry.items() if key not in NON_TOOL_KEYS
        }

    def program(self, tools: Mapping[str, Mapping[str, Any]]) -> Program:
        """Return the program of these tools; a tool may follow another application of the file.

        Raises:
            ConfigurationError: a tool or a setting is wrong; the text names it.
        """
        if not isinstance(tools, Mapping):
            raise wrong_argument("tools", "a mapping from tools to their settings", tools)
        software = self._find_software(self._read_document())
        software["applications"][self.application] = self._entry_with(tools)
        try:
            checked = SoftwareEntry.model_validate(software)
        except ValidationError as exc:
            first = exc.errors(include_url=False)[0]
            raise ConfigurationError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from exc
        try:
            camera = make_camera(self.camera, checked, self.path.parent)
        except ProgramError as exc:
            keys = [str(key) for key in exc.keys if key not in {"applications", self.application}]
            text = f"{'.'.join(keys)}: {exc}" if keys else str(exc)
            raise ConfigurationError(text) from exc
        return camera.programs[self.application]

    def _entry_with(self, tools: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Return the application's entry with the given tools."""
        other_entries = {key: value for key, value in self._entry.items() if key in NON_TOOL_KEYS}
        return {**other_entries, **{key: dict(given) for key, given in tools.items()}}

    def save(self, tools: Mapping[str, Mapping[str, Any]]) -> None:
        """Write the tools into the file, and leave the rest, comments included, unchanged.

        Raises:
            ConfigurationError: a tool or setting is wrong, or the file cannot be written; the file
                is unchanged.
            MissingExtraError: the extra ``inspection`` is not installed.
        """
        self.program(tools)
        entry = self._entry_with(tools)
        yaml: Any = load("ruamel.yaml", "teaching needs").YAML()
        yaml.preserve_quotes = True
        yaml.width = LINE_WIDTH
        text = self._read_text()
        if re.search(r"^( *)[^\s#-].*:\s*(#.*)?\n\1 +- ", text, re.MULTILINE):
            yaml.indent(mapping=2, sequence=4, offset=2)
        document = yaml.load(text)
        applications = document["cameras"][self.camera]["software"]["applications"]
        if isinstance(applications.get(self.application), dict):
            _update_mapping(applications[self.application], entry)
        else:
            applications[self.application] = _as_flow(entry)
        written = io.StringIO()
        yaml.dump(document, written)
        self._check_written(written.getvalue(), entry)
        try:
            replace_file(self.path, written.getvalue().encode())
        except OSError as exc:
            raise ConfigurationError(f"{self.path} cannot be written: {exc}") from exc
        self._entry = entry

    def _check_written(self, text: str, entry: dict[str, Any]) -> None:
        """Raise if the package's own YAML reader reads other settings from the text."""
        expected = self._read_document()
        self._find_software(expected)["applications"][self.application] = entry
        if _as_plain(load_yaml(text, label=str(self.path))) != _as_plain(expected):
            raise ConfigurationError(
                f"{self.path}: the settings cannot be written without changing other lines; write "
                f"them by hand: {entry!r}"
            )

    def _read_text(self) -> str:
        try:
            with self.path.open("rb") as file:
                data = file.read(MAX_FILE_BYTES + 1)
            if len(data) > MAX_FILE_BYTES:
                raise ConfigurationError(f"{self.path}: expected {MAX_FILE_BYTES} bytes at most")
            return data.decode()
        except (OSError, UnicodeDecodeError) as exc:
            raise ConfigurationError(f"{self.path} cannot be read: {exc}") from exc

    def _read_document(self) -> Any:
        try:
            return load_yaml(self._read_text(), label=str(self.path))
        except BadYamlError as exc:
            raise ConfigurationError(f"{self.path}: {exc}") from exc

    def _find_number(self, applications: dict[Any, Any], application: int | str) -> int:
        """Return the number of an application, which may be named by number, digits or name."""
        if not isinstance(application, str) or (application.isascii() and application.isdigit()):
            number = int(application)
            return check_integer(number, "application", 1, MAX_APPLICATION_ID, "Teaching")
        names = {
            str(entry["name"]): number
            for number, entry in applications.items()
            if isinstance(entry, dict) and isinstance(number, int) and "name" in entry
        }
        if application not in names:
            known = [f"{number} ({name})" for name, number in names.items()]
            raise ConfigurationError(
                f"{self.path}: {self.camera} has no application {application!r:.60}; there are "
                f"{', '.join(known) or 'none with a name'}{did_you_mean(application, names)}; a "
                "new number adds an application"
            )
        return names[application]

    def _find_software(self, document: Any) -> dict[str, Any]:
        """Return the mapping ``software:`` of the camera in a file."""
        cameras = document.get("cameras") if isinstance(document, dict) else None
        entry = cameras.get(self.camera) if isinstance(cameras, dict) else None
        software = entry.get("software") if isinstance(entry, dict) else None
        if not isinstance(software, dict) or not isinstance(software.get("applications"), dict):
            known = [*map(str, cameras)] if isinstance(cameras, dict) else []
            raise ConfigurationError(
                f"{self.path}: no software camera {self.camera!r:.80} with applications; there are "
                f"{', '.join(known) or 'no cameras'}{did_you_mean(self.camera, known)}"
            )
        return cast("dict[str, Any]", software)


def _as_plain(value: Any) -> Any:
    """Return a value as a YAML reader returns it: tuples become lists."""
    if isinstance(value, dict):
        return {key: _as_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_plain(item) for item in value]
    return value


def _update_mapping(old: Any, new: Mapping[str, Any]) -> None:
    """Change the differing values of a file's mapping; equal values keep their notation."""
    for key in [key for key in old if key not in new]:
        del old[key]
    for key, value in new.items():
        if isinstance(value, dict) and isinstance(old.get(key), dict):
            _update_mapping(old[key], value)
        elif key not in old or _as_plain(old[key]) != _as_plain(value):
            old[key] = _as_flow(value)


def _as_flow(value: Any) -> Any:
    """Return a value in ruamel's types, which YAML writes on one line."""
    kinds = load("ruamel.yaml.comments", "teaching needs")
    if isinstance(value, dict):
        node = kinds.CommentedMap({key: _as_flow(item) for key, item in value.items()})
    elif isinstance(value, (list, tuple)):
        node = kinds.CommentedSeq([_as_flow(item) for item in value])
    else:
        return value
    node.fa.set_flow_style()
    return node


# ---------------------------------------------------------------------- settings


def tool_settings() -> dict[str, dict[str, str]]:
    """Return the descriptions of settings by kind of tool and name."""
    descriptions: dict[str, dict[str, str]] = {}
    for info in TOOLS.available():
        kind: Any = TOOLS.load(info.name)
        fields = kind.settings_model.model_fields
        descriptions[info.name] = {name: field.description or "" for name, field in fields.items()}
    return descriptions


def read_settings(given: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, Any]]:
    """Parse settings of tools from YAML texts; empty texts are left out.

    Raises:
        ConfigurationError: a text is no YAML.
    """
    settings_read: dict[str, dict[str, Any]] = {}
    for key, settings in given.items():
        settings_read[key] = {}
        for name, text in settings.items():
            if text.strip():
                try:
                    settings_read[key][name] = load_yaml(text, label=f"{key}: {name}")
                except BadYamlError as exc:
                    raise ConfigurationError(f"{key}: {name}: {exc}") from exc
    return settings_read


def setting_text(value: Any) -> str:
    """Return a setting's value as one line of YAML."""
    yaml: Any = load("yaml")
    text: str = yaml.safe_dump(value, default_flow_style=True, width=LINE_WIDTH)
    return text.removesuffix("\n").removesuffix("\n...").strip()
