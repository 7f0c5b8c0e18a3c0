"""The tool `compare`: differences from a taught picture, and changes that are none."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from smartcam.exceptions import ConfigurationError
from tests.inspection.cells import inspected, programs

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

REGION = "[40, 20, 120, 60]"


def label() -> NDArray[np.uint8]:
    """Return a picture of 200 x 100 pixels with a printed label in the region."""
    picture = np.full((100, 200), 90, np.uint8)
    picture[26:74, 48:152] = 220
    cv2.putText(picture, "LOT 47", (56, 58), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 20, 2, cv2.LINE_AA)
    return picture


def compared(folder: Path, picture: NDArray[np.uint8], more: str = "") -> Any:
    cv2.imwrite(str(folder / "good.png"), label())
    cell = f"{{compare: {{taught: good.png, region: {REGION}{more}}}}}"
    return inspected(folder, cell, picture)


def noisy(picture: NDArray[Any], seed: int = 1) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(0, 4, picture.shape)
    levels: Any = np.clip(np.rint(picture + noise), 0, 255)
    seen: NDArray[np.uint8] = levels.astype(np.uint8)
    return seen


def moved(x: float, y: float) -> NDArray[np.uint8]:
    motion = np.array([[1, 0, x], [0, 1, y]], float)
    made = cv2.warpAffine(label(), motion, (200, 100), borderValue=90)
    return made.astype(np.uint8)


def test_same_label_is_ok_with_noise_and_another_light(tmp_path: Path) -> None:
    for gain, offset in ((1.0, 0), (0.7, 0), (1.1, 10), (0.6, 40)):
        found = compared(tmp_path, noisy(label() * gain + offset))
        assert found.ok, found.reason
        assert (found.value.differing, found.value.count) == (0, 0)


def test_light_that_may_not_change_is_a_difference(tmp_path: Path) -> None:
    dark = noisy(label() * 0.6)
    assert not compared(tmp_path, dark, ", light: false").ok


@pytest.mark.parametrize("shift", [(0, 0), (2, -1), (-3, 3), (0.5, 0.5), (1.4, -2.6)])
def test_shifted_label_is_ok_and_the_shift_is_reported(
    tmp_path: Path, shift: tuple[float, float]
) -> None:
    found = compared(tmp_path, noisy(moved(*shift)))
    assert found.ok, found.reason
    assert abs(found.value.shift_x - shift[0]) <= 0.75
    assert abs(found.value.shift_y - shift[1]) <= 0.75


def test_missing_label_is_a_difference(tmp_path: Path) -> None:
    found = compared(tmp_path, noisy(np.full((100, 200), 90, np.uint8)))
    assert not found.ok
    assert found.value.differing > 3000
    assert found.reason == f"{found.value.differing} pixels differ, allowed 0"


def test_missing_label_of_low_contrast_is_a_difference(tmp_path: Path) -> None:
    faint = label()
    faint[faint == 220] = 150
    cv2.imwrite(str(tmp_path / "faint.png"), faint)
    cell = f"{{compare: {{taught: faint.png, region: {REGION}}}}}"
    assert inspected(tmp_path, cell, noisy(faint)).ok
    assert not inspected(tmp_path, cell, noisy(np.full((100, 200), 90, np.uint8))).ok


@pytest.mark.parametrize(
    ("gain", "offset", "reason"),
    [(1.2, 0, "pixels differ"), (1.6, 0, "over-exposed"), (1.0, -130, "too dark")],
)
@pytest.mark.parametrize("missing", [False, True])
def test_print_that_the_light_hides_is_not_ok(
    tmp_path: Path, gain: float, offset: float, reason: str, missing: bool
) -> None:
    dark = offset < 0
    blank = np.full((200, 300), 110.0)
    blank += cv2.GaussianBlur(np.random.default_rng(1).uniform(-900, 900, (200, 300)), (0, 0), 6)
    blank = np.clip(blank + (90 if dark else -20), 30, 255 if dark else 130)
    blank[70:130, 100:200] = 60 if dark else 215
    whole = blank.copy()
    whole[85:115, 115:185] = 110 if dark else 165
    cv2.imwrite(str(tmp_path / "good.png"), np.rint(whole).astype(np.uint8))
    seen = (blank if missing else whole) * gain + offset
    found = inspected(tmp_path, "{compare: {taught: good.png}}", noisy(seen))
    if gain == 1.2 and not missing:
        assert found.ok, found.reason
    else:
        assert not found.ok
        assert reason in found.reason


def test_dark_print_on_over_exposed_paper_is_judged(tmp_path: Path) -> None:
    bright = label() * 1.25
    assert bright.max() > 255
    found = compared(tmp_path, noisy(bright))
    assert found.ok, found.reason
    bright[34:62, 54:148] = 275
    assert not compared(tmp_path, noisy(bright)).ok


def test_damage_is_a_difference_with_its_place(tmp_path: Path) -> None:
    torn = label()
    torn[60:74, 130:152] = 90
    found = compared(tmp_path, noisy(torn))
    assert (found.ok, found.value.count) == (False, 1)
    assert found.value.differing == pytest.approx(14 * 22, rel=0.3)
    (mark,) = [one for one in found.findings["compare"].drawings if one.role == "wrong"]
    low, high = np.min(mark.points, axis=0), np.max(mark.points, axis=0)
    assert np.allclose([*low, *high], [129.5, 59.5, 151.5, 73.5], atol=2)
    assert compared(tmp_path, noisy(torn), ", allowed: 500").ok


def test_wrong_text_is_a_difference(tmp_path: Path) -> None:
    other = label()
    other[34:62, 54:148] = 220
    cv2.putText(other, "LOT 41", (56, 58), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 20, 2, cv2.LINE_AA)
    assert not compared(tmp_path, noisy(other)).ok


def test_region_alone_can_be_taught_and_follows_a_turned_part(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mark.png"), label()[20:80, 40:160])
    part = np.zeros((100, 200), np.uint8)
    part[:] = label()
    cell = (
        "{present: {grey: [200, 255], area: [2000, 9000]}, compare: {follow: present, "
        "taught: mark.png, region: [-59, -29, 120, 60], area: 30, shift: 4}}"
    )
    turn = np.array(cv2.getRotationMatrix2D((110, 50), -20, 1.0), np.float64)
    canvas = np.pad(part, 60, mode="edge")
    turn[:, 2] += 60 - turn[:, :2] @ np.array([60.0, 60.0])
    turned = cv2.warpAffine(canvas, turn, canvas.shape[::-1], borderValue=90)
    found = inspected(tmp_path, cell, noisy(turned))
    assert found.ok, found.reason
    spoiled = turned.copy()
    x, y = found.findings["present"].details[0][:2]
    spoiled[round(y) - 6 : round(y) + 6, round(x) - 6 : round(x) + 6] = 120
    assert not inspected(tmp_path, cell, noisy(spoiled)).ok


def test_picture_of_another_size_has_a_reason(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "good.png"), label())
    found = inspected(tmp_path, "{compare: {taught: good.png}}", label()[:90])
    assert (found.ok, found.reason) == (
        False,
        "the picture has 200 x 90 pixels, the taught one 200 x 100",
    )
    assert inspected(tmp_path, "{compare: {taught: good.png}}", label()).ok


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("region: [150, 20, 120, 60]", "expected a picture of 120 x 60 pixels"),
        ("region: [40, 20, 10, 60], shift: 9", "expected a region of 26 pixels or more"),
        ("region: [[0, 0], [50, 0], [50, 50]]", "expected a region .x, y, width, height."),
    ],
)
def test_region_that_cannot_be_compared_is_refused(
    tmp_path: Path, settings: str, message: str
) -> None:
    cv2.imwrite(str(tmp_path / "good.png"), label())
    with pytest.raises(ConfigurationError, match=message):
        programs(tmp_path, f"7: {{compare: {{taught: good.png, {settings}}}}}")


def test_compare_needs_a_region_to_follow(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "good.png"), label())
    tools = "present: {grey: [0, 40]}, compare: {taught: good.png, follow: present}"
    with pytest.raises(ConfigurationError, match="compare: expected a region"):
        programs(tmp_path, f"7: {{{tools}}}")
