"""Private names of the room for its helpers of tests, or for several tests."""

from __future__ import annotations

from smartcam.ros1._json_messages import RawBytes, encode_operation, from_json, ros1_name, to_json
