"""Read fleet files; each section has a module."""
