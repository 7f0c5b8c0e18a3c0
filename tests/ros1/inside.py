"""Names behind the wall of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.ros1._json_messages import Raw, encoded, from_json, ros1_name, to_json
