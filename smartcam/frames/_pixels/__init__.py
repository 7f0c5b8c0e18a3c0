"""Define pixel formats: their layouts in bytes and their conversion to colours."""
