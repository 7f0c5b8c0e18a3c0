"""Names behind the wall of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam._cli.calibrate import calibrate
from smartcam._cli.options import DIALECTS, Options
