"""Measure what `read` reads: drawn codes, public pictures, and photographs without a code.

``python -m tests.inspection.proofs.codes [--seeds N] [--public FOLDER] [--photographs FOLDER]``

Drawn codes are counted beside zxing-cpp alone, OpenCV and pyzbar (where it is installed). FOLDER of
``--public`` is ``test/samples`` of github.com/zxing-cpp/zxing-cpp: pictures with a text or binary
file of the same name that says what they hold. FOLDER of ``--photographs`` has JPEG or PNG files
without any code, such as ``BSDS500/data/images`` of github.com/BIDS/BSDS500. Exit code 1: a code
was read wrong, one was read where there is none, or a kind is read less often than zxing-cpp alone
reads it, or than :data:`GOALS` says.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from smartcam.inspection import Picture, ToolSetup
from tests.inspection.drawn_codes import Look, draw_code
from tests.inspection.inside import ReadCode, ReadSettings, ReadTool, formats_of, read_codes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Reader = Callable[[str, NDArray[np.uint8]], list[str]]

CONTENTS = {
    "DataMatrix": "SN:47-0815-4711",
    "QRCode": "https://smartcam.example/47",
    "Aztec": "SMARTCAM47",
    "PDF417": "smartcam 0815",
    "Code128": "LOT-4711-AB",
    "EAN13": "4006381333931",
}
"""Text of a drawn code, by its kind."""

LOOKS = {
    "1.5 px a module": Look(px=1.5),
    "2 px": Look(px=2),
    "2 px, 17 degrees": Look(px=2, degrees=17),
    "3 px": Look(px=3),
    "3 px, 30 degrees": Look(px=3, degrees=30),
    "3 px, -20 degrees": Look(px=3, degrees=-20),
    "4 px, 45 degrees": Look(px=4, degrees=45),
    "10 px": Look(px=10),
    "3 px, blur 0.6 modules": Look(px=3, blur_px=1.8),
    "4 px, blur 0.8 modules": Look(px=4, blur_px=3.2),
    "4 px, noise 20": Look(px=4, noise=20),
    "4 px, noise 40": Look(px=4, noise=40),
    "8 px, noise 40": Look(px=8, noise=40),
    "4 px, perspective 25 %": Look(px=4, perspective=0.25, degrees=12),
    "5 px, dots of 90 %": Look(px=5, dots=0.9),
    "6 px, dots of 70 %": Look(px=6, dots=0.7),
    "10 px, dots of 50 %": Look(px=10, dots=0.5),
    "4 px, inverted": Look(px=4, inverted=True),
    "8 px, inverted dots of 70 %": Look(px=8, dots=0.7, inverted=True),
    "4 px, contrast 18": Look(px=4, levels=(100, 118), noise=3),
    "4 px, contrast 8": Look(px=4, levels=(100, 108)),
    "4 px, shade": Look(px=4, levels=(60, 110), shade=120),
}
"""Ways in which drawn codes are seen."""

PUBLIC = {
    "QRCode": [f"qrcode-{n}" for n in range(1, 7)],
    "MicroQRCode": ["microqrcode-1"],
    "DataMatrix": [f"datamatrix-{n}" for n in range(1, 6)],
    "Aztec": ["aztec-1", "aztec-2"],
    "MaxiCode": ["maxicode-1"],
    "PDF417": ["pdf417-1", "pdf417-2", "pdf417-3"],
    "Code128": ["code128-1", "code128-2", "code128-3"],
    "Code93": ["code93-1"],
    "Code39": ["code39-1", "code39-3"],
    "Codabar": ["codabar-1", "codabar-2"],
    "ITF": ["itf-1", "itf-2"],
    "DataBarExp": ["rssexpanded-1", "rssexpanded-2", "rssexpanded-3"],
    "EAN8": ["ean8-1"],
    "EAN13": ["ean13-1", "ean13-2", "ean13-3", "ean13-4", "ean13-extension-1"],
    "UPCA": [f"upca-{n}" for n in range(1, 6)],
    "UPCE": ["upce-1", "upce-2", "upce-3"],
}
"""Folders of the public set by the kind of their codes."""

MISLABELLED = {"ean13-2/23": "9784872348880", "ean13-2/28": "9784872348880"}
"""Pictures of the public set whose file says another number than stands below the bars."""

GOALS = {"QRCode": 123, "DataMatrix": 91, "EAN13": 40, "Code128": 22, "PDF417": 55, "Aztec": 45}
"""Pictures of the public set that have to be read, by kind."""

_OPENCV_LINEAR = {"EAN13", "EAN8", "UPCA"}
_PYZBAR = {
    "QRCode": "QRCODE", "Code128": "CODE128", "EAN13": "EAN13", "PDF417": "PDF417",
}  # fmt: skip


def say(*parts: str, end: str = "\n") -> None:
    """Write a line to standard output."""
    sys.stdout.write(" ".join(parts) + end)


def tool(kind: str, seconds: float = 10.0) -> ReadTool:
    """Return the tool for one kind; "" for all kinds."""
    codes = (kind,) if kind else ()
    settings = ReadSettings.model_validate({"codes": codes, "seconds": seconds, "length": 4000})
    return ReadTool(settings, ToolSetup(folder=Path()))


def with_ladder(kind: str, grey: NDArray[np.uint8]) -> list[ReadCode]:
    """Return the codes that `read` reads, whatever it takes."""
    return tool(kind).read(grey, (0, 0))


def alone(kind: str, grey: NDArray[np.uint8]) -> list[ReadCode]:
    """Return the codes that zxing-cpp reads without preparation."""
    return read_codes(grey, formats_of([kind] if kind else []), np.eye(2, 3))


def by_opencv(kind: str, grey: NDArray[np.uint8]) -> list[str]:
    """Return the texts that OpenCV reads; it knows QR and the codes of shops."""
    if kind == "QRCode":
        text, _, _ = cv2.QRCodeDetector().detectAndDecode(grey)
        return [text] if text else []
    if kind in _OPENCV_LINEAR:
        _, texts, _ = cv2.barcode.BarcodeDetector().detectAndDecodeMulti(grey)[:3]
        return [*texts]
    return []


def by_pyzbar(kind: str, grey: NDArray[np.uint8]) -> list[str]:
    """Return the texts that pyzbar reads."""
    from pyzbar import pyzbar

    if kind not in _PYZBAR:
        return []
    found = pyzbar.decode(grey, [pyzbar.ZBarSymbol[_PYZBAR[kind]]])
    return [one.data.decode(errors="replace") for one in found]


def readers() -> dict[str, Reader]:
    """Return the readers that are there, by name."""
    found: dict[str, Reader] = {
        "zxing-cpp": lambda kind, grey: [code.text for code in alone(kind, grey)],
        "smartcam": lambda kind, grey: [code.text for code in with_ladder(kind, grey)],
        "OpenCV": by_opencv,
    }
    try:
        import pyzbar.pyzbar  # noqa: F401
    except ImportError:
        return found
    return {**found, "pyzbar": by_pyzbar}


# ---------------------------------------------------------------------- drawn codes


def drawn(seeds: int, *, looks: dict[str, Look] = LOOKS) -> tuple[Counter[Any], list[str]]:
    """Return how many each reader reads, by reader, look and kind, and what `read` reads wrong."""
    count: Counter[Any] = Counter()
    wrong: list[str] = []
    for (kind, text), (name, look), seed in itertools.product(
        CONTENTS.items(), looks.items(), range(seeds)
    ):
        grey = draw_code(kind, text, look, np.random.default_rng(seed))
        for reader, read in readers().items():
            texts = read(kind, grey)
            count[reader, name, kind] += text in texts
            if reader == "smartcam":
                wrong += [f"{kind}, {name}, seed {seed}: {one!r}" for one in texts if one != text]
    return count, wrong


def print_drawn(seeds: int) -> bool:
    """Print the table of drawn codes; return True if all is well."""
    count, wrong = drawn(seeds)
    names = [*readers()]
    say(f"Read of {seeds}: {', '.join(names)}\n")
    say("| codes |", " | ".join(CONTENTS), "|")
    say("| --- |", " | ".join("---" for _ in CONTENTS), "|")
    for look in LOOKS:
        cells = [" ".join(str(count[one, look, kind]) for one in names) for kind in CONTENTS]
        say(f"| {look} |", " | ".join(cells), "|")
    sums = {
        one: sum(number for (reader, *_), number in count.items() if reader == one) for one in names
    }
    say(f"\nof {seeds * len(LOOKS) * len(CONTENTS)} in all: {sums}")
    for one in wrong:
        say("read wrong:", one)
    return not wrong and sums["smartcam"] >= sums["zxing-cpp"]


# ---------------------------------------------------------------------- the public set


def pictures(folder: Path, kind: str) -> Iterator[tuple[str, Path, str | bytes]]:
    """Yield name, file and content of each public picture of a kind."""
    for path in sorted(one for name in PUBLIC[kind] for one in (folder / name).iterdir()):
        if path.suffix not in {".png", ".webp", ".jpg", ".gif", ".pgm"}:
            continue
        name = f"{path.parent.name}/{path.stem}"
        text, data = path.with_suffix(".txt"), path.with_suffix(".bin")
        if name in MISLABELLED:
            yield name, path, MISLABELLED[name]
        elif text.exists():
            yield name, path, text.read_bytes().decode()
        elif data.exists():
            yield name, path, data.read_bytes()


def print_public(folder: Path) -> bool:
    """Print the table of the public set; return True if all is well."""
    well = True
    say("\n| public pictures | of | zxing-cpp | smartcam | ms | ms | misses |")
    say("| --- | --- | --- | --- | --- | --- | --- |")
    for kind in PUBLIC:
        total, read, spent = 0, Counter[str](), Counter[str]()
        missed: list[str] = []
        for name, path, content in pictures(folder, kind):
            grey, total = Picture.read(path).grey, total + 1
            for who, reader in (("alone", alone), ("ladder", with_ladder)):
                started = time.process_time()
                codes = reader(kind, grey)
                spent[who] += round(1e6 * (time.process_time() - started))
                good = any(content in (code.text, code.data) for code in codes)
                read[who] += good
                if who == "ladder" and not good:
                    missed.append(name + "".join(f" ({code.text})" for code in codes))
                    well &= not codes or _is_add_on(content, codes)
        times = [f"{spent[who] / 1000 / total:.1f}" for who in ("alone", "ladder")]
        say(f"| {kind} | {total} | {read['alone']} | {read['ladder']} |", " | ".join(times), end="")
        say(f" | {', '.join(missed)} |")
        well &= read["ladder"] >= max(read["alone"], GOALS.get(kind, 0))
    return well


def _is_add_on(content: str | bytes, codes: list[ReadCode]) -> bool:
    """Return True if the code was read, but not the small one beside it."""
    return isinstance(content, str) and any(
        code.kind in {"EAN13", "UPCA", "UPCE"} and content.startswith(code.text) for code in codes
    )


# ---------------------------------------------------------------------- photographs


def print_photographs(folder: Path) -> bool:
    """Print what is read in photographs; return True if it is nothing."""
    every = ReadTool(tool("").settings, ToolSetup(folder=Path()))
    paths = sorted(
        one for one in folder.rglob("*") if one.suffix in {".jpg", ".jpeg", ".png", ".webp"}
    )
    false = 0
    for path in paths:
        grey = Picture.read(path).grey
        codes = every.read(grey, (0, 0))
        false += len(codes)
        for code in codes:
            say(f"false: {path.name}: {code.kind} {code.text!r}, {code.prepared}")
    say(f"\n{len(paths)} photographs: {false} false reads")
    return not false and bool(paths)


def main() -> int:
    """Judge what is asked for; return 1 where something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="drawn codes of each kind and look")
    parser.add_argument("--public", type=Path, help="test/samples of zxing-cpp")
    parser.add_argument("--photographs", type=Path, help="folder of photographs without codes")
    given = parser.parse_args()
    well = print_drawn(given.seeds) if given.seeds else True
    if given.public is not None:
        well &= print_public(given.public)
    if given.photographs is not None:
        well &= print_photographs(given.photographs)
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
