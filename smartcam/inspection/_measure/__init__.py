"""The tool `measure`: find edges, lines and circles, and compute lengths and angles from them."""
