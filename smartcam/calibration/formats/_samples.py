"""Read and write MoveIt's samples of a hand-eye calibration: poses of hand and object.

The tests of MoveIt's solver have JSON: a list of pairs of (4, 4) matrices. MoveIt's panel saves
YAML: a list of mappings, in which each value is a list of the 16 numbers of a matrix, row by row.

Source: github.com/moveit/moveit_calibration, ``pose_samples.json`` and
``handeye_control_widget.cpp``.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration.formats._plain import (
    as_list,
    as_mapping,
    as_matrix,
    as_numbers,
    format_real,
    load_json,
    load_yaml,
    matrix_rows,
    rigid_transform,
)
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array

_HAND_KEY, _OBJECT_KEY = "effector_wrt_world", "object_wrt_sensor"


class HandEyeSample(NamedTuple):
    """One stop of the robot, with the poses there.

    Attributes:
        hand: ``T_base_effector``, the effector's pose in the robot's base.
        seen: ``T_camera_object``, the object's pose in the camera's frame.
    """

    hand: Transform
    seen: Transform


def parse_json(text: str) -> list[HandEyeSample]:
    """Return the samples of a JSON file; frames are base, effector, camera and object."""
    samples = as_list(load_json(text), "file")
    pairs = [as_list(pair, f"sample {index}", 2) for index, pair in enumerate(samples)]
    return [
        _sample(index, *(as_matrix(matrix, f"sample {index}", (4, 4)) for matrix in pair))
        for index, pair in enumerate(pairs)
    ]


def parse_yaml(text: str) -> list[HandEyeSample]:
    """Return the samples of a YAML file; frames are base, effector, camera and object."""
    samples, keys = as_list(load_yaml(text), "file"), (_HAND_KEY, _OBJECT_KEY)
    pairs = [as_mapping(pair, f"sample {index}", keys) for index, pair in enumerate(samples)]
    return [
        _sample(index, *(np.reshape(as_numbers(pair[key], key, 16), (4, 4)) for key in keys))
        for index, pair in enumerate(pairs)
    ]


def _sample(index: int, hand: Array, seen: Array) -> HandEyeSample:
    return HandEyeSample(
        rigid_transform("base", "effector", hand, f"sample {index}, hand"),
        rigid_transform("camera", "object", seen, f"sample {index}, seen"),
    )


def compose_json(samples: Sequence[HandEyeSample]) -> str:
    """Return samples as JSON, which has no place for the frames' names."""
    _check_frames(samples)
    pairs = [[matrix_rows(sample.hand), matrix_rows(sample.seen)] for sample in samples]
    return f"[{','.join(chr(10) + json.dumps(pair) for pair in pairs)}\n]\n"


def compose_yaml(samples: Sequence[HandEyeSample]) -> str:
    """Return samples as YAML, which has no place for the frames' names."""
    _check_frames(samples)
    text = "".join(
        f"- {_HAND_KEY}: [{_matrix_text(sample.hand)}]\n"
        f"  {_OBJECT_KEY}: [{_matrix_text(sample.seen)}]\n"
        for sample in samples
    )
    return text or "[]\n"


def _check_frames(samples: Sequence[HandEyeSample]) -> None:
    for name in HandEyeSample._fields:
        check_same_frames([getattr(sample, name) for sample in samples], f"sample {{}}, {name}")


def check_same_frames(transforms: Sequence[Transform], label: str) -> None:
    """Raise ``WRONG_FRAME`` unless all transforms have the same frames.

    ``label``: template of a transform's name in the error, with ``{}`` for its number.
    """
    for index, transform in enumerate(transforms):
        if (transform.target, transform.source) != (transforms[0].target, transforms[0].source):
            raise Code.WRONG_FRAME.error_with_value(
                f"{label.format(index)}: expected {transforms[0].label}, like {label.format(0)}",
                transforms[0].label,
                transform.label,
            )


def _matrix_text(transform: Transform) -> str:
    return ", ".join(format_real(value) for row in matrix_rows(transform) for value in row)
