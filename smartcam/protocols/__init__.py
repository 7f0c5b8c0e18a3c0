"""Sans-I/O wire protocols: bytes to events and back, for both roles."""
