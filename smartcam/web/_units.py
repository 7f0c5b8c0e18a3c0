"""Units in which a page shows values instead of SI."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.layout._inside import SI_SYMBOLS, ShownUnits

if TYPE_CHECKING:
    from collections.abc import Sequence

PRACTICAL_UNITS = ("mm", "deg")
"""Names of the units that a page's switch shows by default."""


class PageUnits:
    """The units that a page's switch shows, and whether the page begins with them.

    Args:
        names: names of the units with which the page begins; None: the page begins with SI, and
            its switch shows :data:`PRACTICAL_UNITS`.

    Attributes:
        shown: units that the switch shows.
        first: whether the page begins with these units.

    Raises:
        ConfigurationError: a name is no unit, or two are of the same quantity.
    """

    def __init__(self, names: Sequence[str] | None = None) -> None:
        self.shown: ShownUnits = ShownUnits(PRACTICAL_UNITS if names is None else names)
        self.first: bool = names is not None

    def as_json(self) -> dict[str, Any]:
        """Return the units for the page: name and factor, by the SI unit that each replaces."""
        units = {symbol: self.shown.of(symbol) for symbol in SI_SYMBOLS.values()}
        return {
            "first": self.first,
            "instead": {key: [*unit] for key, unit in units.items() if unit.name != key},
        }
