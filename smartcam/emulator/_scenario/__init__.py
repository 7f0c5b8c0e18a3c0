"""Scenarios: data that describes emulated cameras, and events that happen to them."""
