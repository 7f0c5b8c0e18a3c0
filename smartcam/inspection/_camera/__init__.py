"""Software cameras: programs that inspect a source of frames, with a smart camera's protocol."""
