"""Private names of smartcam.doctor that the helpers or several tests use."""

from __future__ import annotations

from smartcam.doctor import _state_checks
from smartcam.doctor._findings import Exit, Severity
