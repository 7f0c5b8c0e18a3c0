"""The emulated In-Sight camera."""
