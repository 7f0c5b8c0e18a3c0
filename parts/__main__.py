"""Build the wheels of all distributions: ``python -m parts FOLDER``."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from parts import CORE, PARTS, lay_out


def build(name: str, out: Path) -> None:
    """Build the wheel of one part."""
    with tempfile.TemporaryDirectory() as folder:
        lay_out(name, Path(folder))
        options = ["--quiet", "--wheel", "--outdir", str(out)]
        subprocess.run([sys.executable, "-m", "build", *options, folder], check=True)  # noqa: S603


def main(out: str) -> None:
    """Build them all into a folder."""
    for name in (CORE, *PARTS):
        build(name, Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
