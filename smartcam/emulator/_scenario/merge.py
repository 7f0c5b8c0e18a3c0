"""Merge a scenario with the options of an emulated camera, which override it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_iterable, check_text
from smartcam._suggestions import did_you_mean
from smartcam.emulator._application import Application, make_application
from smartcam.emulator._bvs.quirks import Quirks
from smartcam.emulator._scenario.file import load_scenario
from smartcam.emulator._scenario.scenario import Scenario
from smartcam.emulator._scenario.timeline import Cue
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import BVS, Transport
from smartcam.settings import validated

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

_KNOWN: Mapping[str, tuple[str, ...]] = {
    "dialect": tuple(BVS.dialects),
    "transport": tuple(transport.value for transport in Transport),
}


def make_plan(
    scenario: Scenario | str | Path | None,
    applications: Iterable[Application | dict[str, Any]],
    timeline: Iterable[Cue | Mapping[str, Any]],
    **given: Any,
) -> Scenario:
    """Return the scenario with the given options; an option that is None was not given.

    Raises:
        ConfigurationError: an option is wrong, or not supported by the camera.
    """
    changes = {key: value for key, value in given.items() if value is not None}
    for option, names in _KNOWN.items():
        if option not in changes:
            continue
        name = changes[option] = check_text(changes[option], option, "emulator", most=100)
        if name not in names:
            raise ConfigurationError(
                f"emulator: {option} {name!r} is unknown; known are {', '.join(names)}"
                f"{did_you_mean(name, names)}"
            )
    if scenario is None:
        base = Scenario()
    elif isinstance(scenario, Scenario):
        base = scenario
    else:
        base = load_scenario(scenario, dialect=changes.get("dialect"))
    if "quirks" in changes:
        changes["quirks"] = validated(Quirks, changes["quirks"], "quirks")
    checked = check_iterable(applications, "applications", "a list of applications", "emulator")
    added = [make_application(application) for application in checked]
    ids = {application.id for application in added}
    changes["applications"] = (*added, *(a for a in base.applications if a.id not in ids))
    timeline = check_iterable(timeline, "timeline", "a list of cues", "emulator")
    cues = (validated(Cue, cue, f"cue {number}") for number, cue in enumerate(timeline, start=1))
    changes["timeline"] = (*base.timeline, *cues)
    plan = base.model_copy(update=changes)
    mistake = plan.mistake()
    if mistake is not None:
        path, text = mistake
        raise ConfigurationError(f"emulator: {'.'.join(str(key) for key in path)}: {text}")
    return plan
