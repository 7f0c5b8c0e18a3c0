"""An emulated camera as data, with the events that happen to it."""
