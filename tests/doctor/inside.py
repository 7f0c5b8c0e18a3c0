"""Names behind the wall of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.doctor import _state_checks
from smartcam.doctor._findings import Exit, Severity
