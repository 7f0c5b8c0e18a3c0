"""A camera's lens: its model, and its calibration from views."""
