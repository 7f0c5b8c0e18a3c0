"""Read scenario files from YAML; a mistake is reported with file, line and field."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_text
from smartcam.emulator._scenario.scenario import Mistake, Scenario, ScenarioFile
from smartcam.exceptions import ConfigurationError
from smartcam.layout._inside import file_schema, read_model

if TYPE_CHECKING:
    from pathlib import Path


def load_scenario(path: str | Path, *, dialect: str | None = None) -> Scenario:
    """Read a scenario file (YAML) with one camera.

    Args:
        path: path of the file.
        dialect: dialect that overrides the file's.

    Raises:
        ConfigurationError: as :func:`load_scenarios`, or the file has several cameras.
        MissingExtraError: PyYAML is not installed.
    """
    first, *others = load_scenarios(path, dialect=dialect)
    if others:
        names = ", ".join(scenario.name for scenario in (first, *others))
        raise ConfigurationError(
            f"scenario {path}: one camera was expected, it has {1 + len(others)}: {names}; "
            "EmulatedFleet takes them all"
        )
    return first


def load_scenarios(path: str | Path, *, dialect: str | None = None) -> tuple[Scenario, ...]:
    """Read a scenario file (YAML): one camera, or several under ``cameras``.

    Args:
        path: path of the file.
        dialect: dialect that overrides the file's.

    Raises:
        ConfigurationError: the file cannot be read or a field of it is wrong; the text names file,
            line and field.
        MissingExtraError: PyYAML is not installed.
    """
    if dialect is not None:
        dialect = check_text(dialect, "dialect", "scenario")

    def cameras_of(file: ScenarioFile) -> tuple[Scenario, ...]:
        scenarios = file.split_cameras()
        if dialect is None:
            return scenarios
        return tuple(scenario.model_copy(update={"dialect": dialect}) for scenario in scenarios)

    def mistake(file: ScenarioFile) -> Mistake | None:
        for index, scenario in enumerate(cameras_of(file)):
            problem = scenario.mistake()
            if problem is not None:
                path, text = problem
                return file.path_in_file(index, path), text
        return None

    return cameras_of(read_model(path, "scenario", ScenarioFile, "applications", mistake))


def scenario_schema() -> dict[str, Any]:
    """Return the JSON Schema of scenario files."""
    return file_schema(ScenarioFile, "scenario")
