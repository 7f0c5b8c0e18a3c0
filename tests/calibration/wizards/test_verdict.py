"""The verdict on a calibration, and the advised choice."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from smartcam.calibration import fit_plane
from smartcam.calibration._verdict import CURES, VIEW_CURES, Allowed, judge, poor_judgement
from smartcam.calibration.wizards._points import plane_outcome
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Mapping

FIELD = np.array([(0.15 * i, 0.12 * j) for i in range(3) for j in range(3)])
SHIFT = np.array([0.4, -0.1])
ALLOWED = Allowed(30.0, is_from_user=True)


@pytest.mark.parametrize(
    ("held_out", "good_for", "text"),
    [
        (0.31, 0.7, "Good for 0.7 mm: "),
        (0.2, 0.4, "Good for 0.4 mm: "),
        (0.06, 0.2, "Good for 0.2 mm: "),
        (0.017, 0.04, "Good for 0.04 mm: "),
        (0.0, 0.001, "Good for 0.001 mm: "),
        (12.34, 24.7, "Good for 24.7 mm: "),
    ],
)
def test_verdict_names_twice_the_held_out_error_rounded_up(
    held_out: float, good_for: float, text: str
) -> None:
    judged = judge(held_out, [(Code.NOT_SIMILAR, "tilted")], worst=1, allowed=ALLOWED)
    assert (judged.good_for, judged.option) == (good_for, "accept")
    assert (judged.verdict.level, judged.verdict.text[: len(text)]) == ("good", text)


def test_verdict_promises_no_less_than_the_noise_leads_to() -> None:
    judged = judge(0.01, [], worst=1, predicted=0.16, allowed=ALLOWED, where=" without point 3")
    assert judged.good_for == 0.4
    assert judged.verdict.text.startswith("Good for 0.4 mm without point 3: 95 of 100")


def test_verdict_is_not_good_beyond_the_allowed_error() -> None:
    for allowed, why in (
        (Allowed.of(0.003, 0.4), "but 3 mm are allowed: "),
        (Allowed.of(None, 0.25), "but 2.5 mm are allowed, 1 % of the field, the default: "),
    ):
        judged = judge(1.6, [], worst=1, allowed=allowed)
        assert (judged.verdict.level, judged.good_for, judged.option) == ("poor", None, "more")
        assert why in judged.verdict.text
        assert judge(1.2, [], worst=1, allowed=allowed).verdict.level == "good"


def test_verdict_is_unknown_if_all_may_be_mirrored() -> None:
    judged = judge(0.1, [(Code.SIDE_UNKNOWN, "not checked")], worst=1, allowed=ALLOWED)
    assert (judged.verdict.level, judged.good_for) == ("unknown", None)
    assert judged.choose_option(["accept", "more", "redo", "side"]) == "side"
    assert judged.choose_option(["accept", "more", "redo"]) == "redo"
    assert "say where the tool points" in judged.verdict.text


def test_verdict_without_a_held_out_error_is_not_known() -> None:
    judged = judge(None, [(Code.NOT_HELD_OUT, "too few")], worst=1, allowed=ALLOWED)
    assert (judged.verdict.level, judged.option, judged.good_for) == ("unknown", "more", None)
    assert judged.verdict.text == "Not known how good: touch more points"


def test_verdict_names_the_point_of_the_warning_that_is_to_be_mended_first() -> None:
    wrong = [(Code.POOR_FIT, "the residuals"), (Code.OUTLIER, "point 3 fits far worse")]
    judged = judge(0.1, wrong, worst=5, allowed=ALLOWED)
    assert (judged.verdict.text, judged.option, judged.number) == (
        "Not good enough: touch point 3 again", "redo", 3,
    )  # fmt: skip
    assert judge(0.1, wrong[:1], worst=5, allowed=ALLOWED).number == 5


@pytest.mark.parametrize("cures", [CURES, VIEW_CURES])
def test_verdict_of_each_fault_names_the_cure(
    cures: Mapping[Code, tuple[str, str]],
) -> None:
    for code, (_, option) in cures.items():
        judged = poor_judgement(code, "it is", worst=4, cures=cures)
        assert judged.verdict.text.startswith("Not good enough: ")
        assert "{" not in judged.verdict.text
        assert judged.option == option
        assert judged.choose_option(["accept", option]) == option
        assert judged.choose_option(["accept", "more"]) == (
            "more" if option != "accept" else option
        )


@pytest.mark.long
def test_verdict_holds_for_new_points() -> None:
    """With the verdict good, 95 of 100 new touches lie within the promised error."""
    random = np.random.default_rng(11)
    inside: list[float] = []
    new = random.uniform((0.0, 0.0), (0.3, 0.24), (200, 2))
    for _ in range(60):
        touches = np.column_stack([FIELD + SHIFT, np.zeros(9)])
        touches += random.normal(0.0, 0.0002, touches.shape)
        found = fit_plane(FIELD, touches, touch_sigma=0.0002, tool_z=(0, 0, -1))
        judged = plane_outcome(found).judgement
        if judged.good_for is not None:
            true = np.column_stack([new + SHIFT, np.zeros(200)])
            off = true + random.normal(0.0, 0.0002, true.shape) - found.transform(new)
            inside.append(float((np.linalg.norm(off, axis=1) < 1e-3 * judged.good_for).mean()))
    assert len(inside) > 50
    assert np.mean(inside) > 0.95
