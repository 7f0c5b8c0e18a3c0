"""Is it a BVS camera? Is it a good client? Judged from outside, with code of its own."""
