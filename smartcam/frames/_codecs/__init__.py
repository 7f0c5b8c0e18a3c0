"""Encode and decode pictures in threads: JPEG, PNG, JPEG XL, bitmaps, H.264."""
