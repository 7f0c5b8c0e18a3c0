"""Trigger a GigE Vision camera, and find the picture that a trigger caused.

The next picture belongs to the pending trigger, with three exceptions: the camera's clock, read
right before the trigger, shows that the picture was exposed earlier; a picture was lost meanwhile;
or an event of the camera names another block. If the clock cannot be read, the only evidence is
that all earlier pictures of the stream have come.

Source: SFNC 2.7, chapter 5 (``TriggerSelector``, ``TriggerMode``, ``TriggerSource``,
``TriggerSoftware``); GigE Vision 2.0, chapter 28 (timestamp latch).
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.exceptions import FrameSourceError, NotRunningError, UnsupportedError
from smartcam.frames._frame import FrameTrigger
from smartcam.frames._trigger import MAX_NOTES

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.frames._events import FrameEvent
    from smartcam.frames._gige.block import WholePicture
    from smartcam.frames._gige.features import GenicamFeatures
    from smartcam.frames._trigger import AwaitedTrigger

EXPOSURE_END_EVENT: Final = "ExposureEnd"
MISSED_EVENT: Final = "FrameTriggerMissed"
"""Name of the event for a trigger that caused no picture."""

MAX_EXPOSURES: Final = 16
"""Largest number of exposures of one trigger that are kept."""

SOFTWARE: Final = "Software"
FRAME_START: Final = "FrameStart"


class TriggerSetting(NamedTuple):
    """A kind of trigger that is switched on.

    Attributes:
        selector: entry of TriggerSelector; ``""``: the camera has only one kind.
        source: entry of TriggerSource; ``""``: unknown.
    """

    selector: str
    source: str

    def __str__(self) -> str:
        """Return the setting as a text for errors."""
        which = f" for {self.selector}" if self.selector else ""
        source = f", TriggerSource {self.source}" if self.source else ""
        return f"its TriggerMode is On{which}{source}"


async def read_settings(features: GenicamFeatures) -> list[TriggerSetting]:
    """Return the kinds of triggers that are switched on; TriggerSelector is restored.

    Raises:
        FrameSourceError: the camera does not answer.
    """
    if "TriggerMode" not in features:
        return []
    if "TriggerSelector" not in features:
        return await _setting_of(features, "")
    previous = await features.get("TriggerSelector")
    settings: list[TriggerSetting] = []
    try:
        for selector in await features.entries("TriggerSelector"):
            await features.set("TriggerSelector", selector)
            settings += await _setting_of(features, selector)
    finally:
        await features.set("TriggerSelector", previous)
    return settings


async def _setting_of(features: GenicamFeatures, selector: str) -> list[TriggerSetting]:
    if await _text_of(features, "TriggerMode") != "On":
        return []
    return [TriggerSetting(selector, await _text_of(features, "TriggerSource"))]


async def _text_of(features: GenicamFeatures, name: str) -> str:
    """Return a feature's text, or "" if it is not available now."""
    if name not in features:
        return ""
    try:
        return str(await features.get(name))
    except FrameSourceError as exc:
        if isinstance(exc, TimeoutError):
            raise
        return ""


async def set_trigger(features: GenicamFeatures, source: str) -> None:
    """Set the source of triggers, each of which causes one picture; ``off``: no triggers.

    Raises:
        FrameSourceError: the camera has no such source; the text lists the existing ones.
    """
    if "TriggerSelector" in features:
        for selector in await features.entries("TriggerSelector"):
            if selector != FRAME_START:
                await features.set("TriggerSelector", selector)
                if await _text_of(features, "TriggerMode") == "On":
                    await features.set("TriggerMode", "Off")
        await features.set("TriggerSelector", FRAME_START)
    if source.lower() == "off":
        await features.set("TriggerMode", "Off")
        return
    sources = await features.entries("TriggerSource")
    entry = {known.lower(): known for known in sources}.get(source.lower(), source)
    # some cameras have a source only while the trigger is switched on
    await features.set("TriggerMode", "On")
    await features.set("TriggerSource", entry)


async def usable_setting(
    settings: list[TriggerSetting], features: GenicamFeatures, by_line: bool, name: str
) -> TriggerSetting:
    """Return the setting of the only trigger, which must cause exactly one picture.

    Raises:
        NotRunningError: no trigger is switched on, or only from another source.
        UnsupportedError: a trigger causes several pictures, or several triggers are needed for one.
    """
    if not settings:
        raise NotRunningError(
            f"{name}: its TriggerMode is Off, so it takes no trigger: open it with "
            "?trigger=Software, or set TriggerSelector, TriggerMode and TriggerSource"
        )
    setting = settings[0]
    if len(settings) > 1 or setting.selector not in ("", FRAME_START):
        shown = "; ".join(map(str, settings))
        raise UnsupportedError(
            f"{name}: expected one trigger for each picture, TriggerMode On for {FRAME_START} "
            f"alone, got: {shown}"
        )
    is_software = setting.source == SOFTWARE or not (setting.source or by_line)
    if by_line and is_software:
        raise NotRunningError(
            f"{name}: `fire` sets a line, but {setting}: set TriggerSource to that line"
        )
    if not by_line and not is_software:
        raise NotRunningError(
            f"{name}: {setting}: set TriggerSource to {SOFTWARE}, or pass `fire`, a function that "
            "sets that line; for a picture that others trigger, use source.after(time.monotonic())"
        )
    return setting


@contextlib.asynccontextmanager
async def selected_trigger(
    features: GenicamFeatures, setting: TriggerSetting
) -> AsyncIterator[None]:
    """Set TriggerSelector to a trigger within the ``with`` statement, then restore it.

    Raises:
        FrameSourceError: the camera does not answer.
    """
    previous = await features.get("TriggerSelector") if setting.selector else ""
    if previous == setting.selector:
        yield
        return
    await features.set("TriggerSelector", setting.selector)
    try:
        yield
    finally:
        await features.set("TriggerSelector", previous)


class ArmedTrigger:
    """A trigger that waits for its picture.

    Args:
        pending: the trigger of the source.
        latched_ticks: the camera's clock right before the trigger, ticks; None: it cannot be read.
        setting: kind of the trigger.
        delay: seconds from the trigger to its exposure (``TriggerDelay``).
        is_first: whether the stream has had no picture yet.
    """

    def __init__(
        self,
        pending: AwaitedTrigger,
        latched_ticks: int | None,
        setting: TriggerSetting,
        *,
        delay: float,
        is_first: bool,
    ) -> None:
        self.pending, self.delay = pending, delay
        self._latched_ticks, self._setting, self._is_first = latched_ticks, setting, is_first
        self.exposed: list[int] = []
        """Blocks exposed since the trigger, according to the camera's events."""

    def is_older(self, picture: WholePicture) -> bool:
        """Return True if a picture was exposed before the trigger, on the camera's clock."""
        ticks = picture.leader.ticks
        is_earlier = self._latched_ticks is not None and 0 < ticks < self._latched_ticks
        if is_earlier:
            self._add_note(f"block {picture.block_id} came, which was exposed before the trigger")
        return is_earlier

    def reason_for_doubt(self, picture: WholePicture, *, event_ids_match: bool) -> str:
        """Return the reason why a picture may belong to another trigger, or ``""``.

        Args:
            picture: picture that came first.
            event_ids_match: whether this camera's events are known to name blocks as pictures do.
        """
        if picture.lost > 0 and not self._is_first:
            return f"{picture.lost} pictures right before it came incomplete, or not at all"
        if event_ids_match and self.exposed and picture.block_id not in self.exposed:
            return f"the camera exposed block {self.exposed[0]} for it, which did not come"
        return ""

    def on_event(self, event: FrameEvent, ticks: float | None) -> bool:
        """Record an event of the camera; return True if it reports a missed trigger.

        Args:
            event: reported event.
            ticks: the event's time on the camera's clock; None: no time.
        """
        if ticks is not None and self._latched_ticks is not None and ticks < self._latched_ticks:
            return False
        if event.name == MISSED_EVENT:
            return True
        if event.block and len(self.exposed) < MAX_EXPOSURES:
            self.exposed.append(event.block)
            self._add_note(f"its event {event.name} says that it exposed block {event.block}")
        return False

    def _add_note(self, text: str) -> None:
        if len(self.pending.notes) < MAX_NOTES:
            self.pending.notes.append(text)

    def to_frame_trigger(self, picture: WholePicture, ticks_per_second: int) -> FrameTrigger:
        """Return the trigger with the evidence that it caused a picture."""
        evidence: list[str] = []
        if picture.block_id in self.exposed:
            evidence.append(
                f"the camera's event {EXPOSURE_END_EVENT} names its block {picture.block_id}"
            )
        if self._latched_ticks is not None and picture.leader.ticks:
            delay = (picture.leader.ticks - self._latched_ticks) / ticks_per_second
            evidence.append(
                f"it was exposed {1e3 * delay:.3f} ms after the camera's clock was read, right "
                "before the trigger"
            )
        if self._setting.source == SOFTWARE:
            evidence.append(
                "only this program may trigger it by software, and no picture of an earlier "
                "trigger was still to come"
            )
        else:
            evidence.append(
                f"the first picture of {self._setting.source} after `fire` was called; any other "
                "pulse on that line would count as well"
            )
        fired = self.pending.fired or 0.0
        return FrameTrigger(self.pending.number, fired, tuple(evidence))
