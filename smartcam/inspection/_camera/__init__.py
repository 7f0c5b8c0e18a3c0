"""Software cameras: programs that look at a source of frames, behind the wire of a smart camera."""
