"""Samples of a hand-eye calibration as MoveIt keeps them: where the hand was, what the camera saw.

Its solver's tests have JSON, a list of pairs of (4, 4) matrices; its panel saves YAML, a list of
mappings to 16 numbers, row by row.

Source: github.com/moveit/moveit_calibration, ``pose_samples.json`` and
``handeye_control_widget.cpp`` (published).
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, NamedTuple

from smartcam.calibration._codes import Code
from smartcam.calibration.formats._plain import (
    Plain,
    load_json,
    load_yaml,
    mapping,
    matrix_rows,
    number,
    real,
    rigid,
    sequence,
)
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._geometry.frames import Transform

_HAND, _SEEN = "effector_wrt_world", "object_wrt_sensor"


class HandEyeSample(NamedTuple):
    """One stop of the robot.

    Attributes:
        hand: ``T_base_effector``, the effector's pose in the robot's base.
        seen: ``T_camera_object``, the object's pose in the camera.
    """

    hand: Transform
    seen: Transform


def parse_json(text: str) -> list[HandEyeSample]:
    """Return the samples of a JSON file; frames are base, effector, camera and object."""
    pairs = [
        sequence(pair, f"sample {index}", 2)
        for index, pair in enumerate(sequence(load_json(text), "file"))
    ]
    return [_sample(_flat(hand), _flat(seen), index) for index, (hand, seen) in enumerate(pairs)]


def parse_yaml(text: str) -> list[HandEyeSample]:
    """Return the samples of a YAML file; frames are base, effector, camera and object."""
    pairs = [
        mapping(pair, f"sample {index}", [_HAND, _SEEN])
        for index, pair in enumerate(sequence(load_yaml(text), "file"))
    ]
    return [_sample(pair[_HAND], pair[_SEEN], index) for index, pair in enumerate(pairs)]


def _flat(matrix: Plain) -> list[Plain]:
    rows = [sequence(row, "matrix row", 4) for row in sequence(matrix, "matrix", 4)]
    return [value for row in rows for value in row]


def _sample(hand: Plain, seen: Plain, index: int) -> HandEyeSample:
    return HandEyeSample(
        _matrix("base", "effector", hand, f"sample {index}, hand"),
        _matrix("camera", "object", seen, f"sample {index}, seen"),
    )


def _matrix(target: str, source: str, values: Plain, where: str) -> Transform:
    read = [number(value, where) for value in sequence(values, where, 16)]
    return rigid(target, source, [read[i : i + 4] for i in range(0, 16, 4)], where)


def compose_json(samples: Sequence[HandEyeSample]) -> str:
    """Return samples as JSON; the frames' names have no place in it."""
    _check(samples)
    pairs = [[matrix_rows(one.hand), matrix_rows(one.seen)] for one in samples]
    return f"[{','.join(chr(10) + json.dumps(pair) for pair in pairs)}\n]\n"


def compose_yaml(samples: Sequence[HandEyeSample]) -> str:
    """Return samples as YAML; the frames' names have no place in it."""
    _check(samples)
    text = "".join(
        f"- {_HAND}: [{_listed(one.hand)}]\n  {_SEEN}: [{_listed(one.seen)}]\n" for one in samples
    )
    return text or "[]\n"


def _check(samples: Sequence[HandEyeSample]) -> None:
    same_frames([one.hand for one in samples])
    same_frames([one.seen for one in samples])


def same_frames(transforms: Sequence[Transform]) -> None:
    """Raise (``WRONG_FRAME``) where not all are between the same frames: the file cannot tell."""
    for index, one in enumerate(transforms):
        if (one.target, one.source) != (transforms[0].target, transforms[0].source):
            raise CalibrationError(
                f"number {index}: expected {transforms[0].label} as the first is, got {one.label}",
                code=Code.WRONG_FRAME,
                expected=transforms[0].label,
                got=one.label,
            )


def _listed(transform: Transform) -> str:
    return ", ".join(real(value) for row in matrix_rows(transform) for value in row)
