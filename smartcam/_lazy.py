"""Import the names of a package when they are first used."""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


def lazy(door: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package's door, and set the door's ``__dir__``.

    A door is the module by which others import from a package. For type checkers it imports the
    same names under ``if TYPE_CHECKING``.

    Args:
        door: name of the package, or of its module ``_inside``.
        names: maps each module of the package to its names, separated by spaces. For names that are
            submodules, the key is their parent's name and a dot, or ``""``. A key that begins
            with ``smartcam.`` is a module of another package.
    """
    homes = {name: module for module, words in names.items() for name in words.split()}
    door_names = vars(sys.modules[door])
    package: str = door_names["__package__"]

    def resolve(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {door!r} has no attribute {name!r}")
        home = homes[name]
        is_module = not home or home.endswith(".")
        module_name = home if home.startswith("smartcam.") else f"{package}.{home}"
        module = importlib.import_module(f"{module_name}{name if is_module else ''}")
        value = door_names[name] = module if is_module else getattr(module, name)
        return value

    door_names["__dir__"] = lambda: sorted({*door_names, *homes})
    return resolve
