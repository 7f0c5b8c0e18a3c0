"""Offer the features of a GigE Vision camera to users, through its open session."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from smartcam.frames._features import DeviceFeatures, Feature, FeatureValue

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.frames._gige.features import GenicamFeatures

POLL_INTERVAL: Final = 0.02
"""Seconds between two polls of a command's state."""


class GigEFeatures(DeviceFeatures):
    """The features that the camera's GenICam description lists.

    Args:
        get_features: coroutine function that returns the features of the open session.
        on_change: coroutine function that is called after a feature was set.
        lock: lock that is held while features are set or a command runs.
    """

    def __init__(
        self,
        get_features: Callable[[], Awaitable[GenicamFeatures]],
        on_change: Callable[[], Awaitable[None]],
        lock: asyncio.Lock,
    ) -> None:
        self._get_features, self._on_change, self._lock = get_features, on_change, lock

    async def names(self) -> list[str]:
        """Return the names of all features, as the description's categories list them."""
        return (await self._get_features()).names()

    async def describe(self, name: str) -> Feature:
        """Return a feature with its present value and range."""
        return await (await self._get_features()).describe(name)

    async def get(self, name: str) -> FeatureValue:
        """Return the value of a feature."""
        return await (await self._get_features()).get(name)

    async def set(self, name: str, value: FeatureValue) -> FeatureValue:
        """Set a feature; return the camera's new value."""
        async with self._lock:
            features = await self._get_features()
            features.check_command(name, is_command=False)
            await features.set(name, value)
            await self._on_change()
        feature = await features.describe(name)
        return value if feature.value is None else feature.value

    async def execute(self, name: str) -> None:
        """Execute a command, and wait until it is done."""
        async with self._lock:
            features = await self._get_features()
            features.check_command(name)
            await features.execute(name)
            while not await features.is_done(name):  # noqa: ASYNC110 - the camera has to be asked
                await asyncio.sleep(POLL_INTERVAL)
            await self._on_change()
