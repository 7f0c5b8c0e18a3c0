"""Proofs of the room: each module's docstring says what it proves."""
