"""The tool `read`: read codes by zxing-cpp."""
