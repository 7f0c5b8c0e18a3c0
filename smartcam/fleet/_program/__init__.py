"""The program's side of a fleet: cameras, calls and subscriptions."""
