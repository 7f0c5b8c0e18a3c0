"""Two cameras that look at the same place."""
