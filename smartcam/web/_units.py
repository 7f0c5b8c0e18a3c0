"""Choose the units in which a page shows values instead of SI units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.layout._inside import SI_SYMBOLS, ShownUnits

if TYPE_CHECKING:
    from collections.abc import Sequence

PRACTICAL_UNITS = ("mm", "deg")
"""Names of the units that a page's switch offers by default."""


class PageUnits:
    """The units that a page's switch offers instead of SI, and whether the page begins with them.

    Args:
        names: names of the units with which the page begins; None: the page begins with SI, and
            its switch offers :data:`PRACTICAL_UNITS`.

    Attributes:
        shown: units that the switch offers.
        shown_first: whether the page begins with these units; else with SI.

    Raises:
        ConfigurationError: a name is no unit, or two units are of the same quantity.
    """

    def __init__(self, names: Sequence[str] | None = None) -> None:
        self.shown: ShownUnits = ShownUnits(PRACTICAL_UNITS if names is None else names)
        self.shown_first: bool = names is not None

    def as_json(self) -> dict[str, Any]:
        """Return the units for the page: name and factor of each, by the SI unit it replaces."""
        units = {symbol: self.shown.of(symbol) for symbol in SI_SYMBOLS.values()}
        return {
            "shown_first": self.shown_first,
            "instead": {si: [*unit] for si, unit in units.items() if unit.name != si},
        }
