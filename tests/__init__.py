"""Tests, in rooms like those of the library; each room's helpers stand beside its tests."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
"""The checkout."""
