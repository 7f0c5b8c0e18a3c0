"""Images and scenes whose truth is known, for tests."""
