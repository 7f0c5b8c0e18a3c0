"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.layout import _compiled, _yaml_files, _yaml_parsing
from smartcam.layout._text import MAX_TEXT_CHARACTERS, parse_text
from smartcam.layout._yaml_parsing import MAX_YAML_TEXT_CHARACTERS
