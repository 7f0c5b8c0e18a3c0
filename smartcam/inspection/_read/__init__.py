"""The tool `read`: codes, by zxing-cpp."""
