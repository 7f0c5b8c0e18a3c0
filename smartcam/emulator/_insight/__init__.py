"""The emulated Cognex In-Sight camera."""
