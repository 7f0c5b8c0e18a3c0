"""The distributions that smartcam can be installed as, and the tree that each is built from.

``python -m parts FOLDER`` builds the wheels of all of them. Which modules each one holds stands in
``parts.toml``; the import name is ``smartcam`` for all, and the version is one.
"""

from __future__ import annotations

import fnmatch
import re
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
"""The checkout."""

PACKAGE = ROOT / "smartcam"

CORE = "core"
"""Name of what is in no other part: the distribution ``smartcam``."""


@dataclass(frozen=True)
class Part:
    """A distribution beside ``smartcam`` itself.

    Attributes:
        name: what stands behind ``smartcam-`` in the distribution's name.
        about: what it is for, one sentence.
        needs: other parts that its modules import.
        extras: extras of ``smartcam`` that bring it.
        modules: patterns of its files, as ``parts.toml`` explains them.
    """

    name: str
    about: str
    needs: frozenset[str]
    extras: tuple[str, ...]
    modules: tuple[str, ...]

    @property
    def distribution(self) -> str:
        """The name to install."""
        return f"smartcam-{self.name}"

    def covers(self, file: str) -> int:
        """Return the length of the longest pattern that a file of the package matches, else 0."""
        found = (
            len(one)
            for one in self.modules
            if (one.endswith("/") and file.startswith(one)) or fnmatch.fnmatchcase(file, one)
        )
        return max(found, default=0)


def _read() -> dict[str, Part]:
    text = (Path(__file__).parent / "parts.toml").read_text(encoding="utf-8")
    return {
        name: Part(
            name, one["about"], frozenset(one["needs"]), tuple(one["extras"]), tuple(one["modules"])
        )
        for name, one in tomllib.loads(text).items()
    }


PARTS = _read()
"""All parts but the core, by name."""


def part_of(file: Path) -> str:
    """Return the name of the part that holds a file of the package: the longest pattern decides."""
    name = file.relative_to(PACKAGE).as_posix()
    best = max(PARTS.values(), key=lambda part: part.covers(name))
    return best.name if best.covers(name) else CORE


def files_of(name: str) -> list[Path]:
    """Return the files of the package that a part holds."""
    found = (one for one in sorted(PACKAGE.rglob("*")) if one.is_file())
    return [one for one in found if "__pycache__" not in one.parts and part_of(one) == name]


def lay_out(name: str, folder: Path) -> None:
    """Write the tree that a part is built from: its files, its ``pyproject.toml``, the licence."""
    for file in files_of(name):
        place = folder / file.relative_to(ROOT)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, place)
    for name_of_file in ("LICENSE", "README.md"):
        shutil.copyfile(ROOT / name_of_file, folder / name_of_file)
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    made = core_project(text) if name == CORE else _part_project(PARTS[name], text)
    (folder / "pyproject.toml").write_text(made, encoding="utf-8")


def core_project(text: str) -> str:
    """Return the project's own ``pyproject.toml``, with extras that bring the other parts."""
    version = _project(text)["version"]
    for part in PARTS.values():
        for extra in part.extras:
            begins = f'{extra} = ["{part.distribution}=={version}", '
            text, count = re.subn(rf"^{extra} = \[", begins, text, flags=re.MULTILINE)
            if count != 1:
                raise LookupError(f"{part.distribution}: pyproject.toml has {count} extras {extra}")
    return text


def _part_project(part: Part, text: str) -> str:
    project = _project(text)
    version = project["version"]
    needs = ["smartcam", *(PARTS[one].distribution for one in sorted(part.needs))]
    return f"""\
[build-system]
requires = ["hatchling>=1.26"]
build-backend = "hatchling.build"

[project]
name = "{part.distribution}"
version = "{version}"
description = "{part.about}"
requires-python = "{project["requires-python"]}"
license = "{project["license"]}"
license-files = ["LICENSE"]
dependencies = {[f"{one}=={version}" for one in needs]}

[tool.hatch.build.targets.wheel]
packages = ["smartcam"]
"""


def _project(text: str) -> dict[str, Any]:
    found: dict[str, Any] = tomllib.loads(text)["project"]
    return found
