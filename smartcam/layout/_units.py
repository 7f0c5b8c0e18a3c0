"""Choose the units in which people see values.

Inside programs values are in SI. Only texts for people may have other units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError, LayoutError
from smartcam.layout._classes import describes_layout, read_class
from smartcam.layout._compiled import compile_text
from smartcam.layout._text import SI_SYMBOLS, UNITS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from smartcam.layout import Layout
    from smartcam.layout._text import Field


class ShownUnit(NamedTuple):
    """The unit in which people see a quantity.

    Attributes:
        name: name of the unit.
        factor: number by which an SI value is multiplied.
    """

    name: str
    factor: float


class ShownUnits:
    """The units in which people see values.

    Args:
        names: names of units, at most one per quantity; other quantities are shown in SI units.

    Raises:
        ConfigurationError: a name is no unit, or two names have the same quantity.
    """

    def __init__(self, names: Iterable[str] = ()) -> None:
        self._by_symbol: dict[str, ShownUnit] = {}
        known = [name for name, unit in UNITS.items() if unit.quantity in SI_SYMBOLS]
        for name in names:
            if name not in known:
                raise ConfigurationError(
                    f"unit {name!r:.40} is unknown; known are {', '.join(known)}"
                    f"{did_you_mean(name, known)}"
                )
            unit = UNITS[name]
            symbol = SI_SYMBOLS[unit.quantity]
            if symbol in self._by_symbol:
                other = self._by_symbol[symbol].name
                raise ConfigurationError(f"{other} and {name} are both units of {unit.quantity}")
            self._by_symbol[symbol] = ShownUnit(name, unit.divide / unit.multiply)

    def of(self, symbol: str) -> ShownUnit:
        """Return the unit in which people see values in the SI unit ``symbol``; "": no unit."""
        return self._by_symbol.get(symbol) or ShownUnit(symbol, 1.0)

    def shown(self, value: object, symbol: str) -> object:
        """Convert a value to the unit that people see."""
        if not symbol or isinstance(value, bool) or not isinstance(value, (int, float)):
            return value
        factor = self.of(symbol).factor
        return value if factor == 1.0 else value * factor


def units_of(value: object, layout: Layout | None = None) -> Mapping[str, str]:
    """Return the SI units of a value's fields by name; fields without a unit are left out.

    ``value``: a record, an object of a class that describes a layout, a list of either, or a table,
    whose units only ``layout`` knows.
    """
    if isinstance(value, list):
        items: list[object] = value
        return units_of(items[0], layout) if items else {}
    units: Mapping[str, str] | None = getattr(type(value), "_units", None)
    if units is not None:
        return units
    kind: Any = type(value)
    if describes_layout(kind):
        try:
            spec = compile_text(read_class(kind).text, 0, lenient=False).spec
        except LayoutError:
            return {}  # its text is no layout: results of this class are interpreted otherwise
        return units_by_name(spec.head or spec.fields)
    dtype: Any = getattr(value, "dtype", None)
    return units_by_name(layout.fields) if layout and getattr(dtype, "names", None) else {}


def units_by_name(fields: Iterable[Field]) -> dict[str, str]:
    """Return the SI units by field name, for fields that have one."""
    return {field.name: field.symbol for field in fields if field.symbol}
