"""The applications of an emulated camera without given ones."""

from __future__ import annotations

from smartcam.emulator import EmulatedCamera

BUILTIN_APPLICATIONS = tuple(EmulatedCamera().device.applications.values())

LOCALIZATIONS = next(one.layout or "" for one in BUILTIN_APPLICATIONS if one.name == "tangram")
"""Layout of a container of localizations."""
