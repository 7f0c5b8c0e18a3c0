"""Names of a package that are resolved when they are first used."""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


def lazy(package: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a package's ``__getattr__``, having given it its ``__dir__``.

    For type checkers the package imports the same names where ``TYPE_CHECKING`` is set.

    Args:
        package: its name.
        names: module of the package to the names that stand in it, with spaces between them; the
            modules that are names themselves stand at ``""``.
    """
    homes = {name: module for module, found in names.items() for name in found.split()}
    own = vars(sys.modules[package])

    def resolve(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = homes[name]
        module = importlib.import_module(f"{package}.{home or name}")
        value = own[name] = getattr(module, name) if home else module
        return value

    own["__dir__"] = lambda: sorted({*own, *homes})
    return resolve
