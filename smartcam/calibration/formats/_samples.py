"""Read and write MoveIt's samples of a hand-eye calibration: poses of hand and object.

The tests of MoveIt's solver have JSON, a list of pairs of (4, 4) matrices; its panel saves YAML, a
list of mappings, each value a list of the 16 numbers of a matrix, row by row.

Source: github.com/moveit/moveit_calibration, ``pose_samples.json`` and
``handeye_control_widget.cpp`` (published).
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration.formats._plain import (
    load_json,
    load_yaml,
    mapping,
    matrix_of,
    matrix_rows,
    real,
    reals,
    rigid,
    sequence,
)
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array

_HAND, _SEEN = "effector_wrt_world", "object_wrt_sensor"


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
    samples = sequence(load_json(text), "file")
    pairs = [sequence(pair, f"sample {index}", 2) for index, pair in enumerate(samples)]
    return [
        _sample(index, *(matrix_of(matrix, f"sample {index}", (4, 4)) for matrix in pair))
        for index, pair in enumerate(pairs)
    ]


def parse_yaml(text: str) -> list[HandEyeSample]:
    """Return the samples of a YAML file; frames are base, effector, camera and object."""
    samples, keys = sequence(load_yaml(text), "file"), (_HAND, _SEEN)
    pairs = [mapping(pair, f"sample {index}", keys) for index, pair in enumerate(samples)]
    return [
        _sample(index, *(np.reshape(reals(pair[key], key, 16), (4, 4)) for key in keys))
        for index, pair in enumerate(pairs)
    ]


def _sample(index: int, hand: Array, seen: Array) -> HandEyeSample:
    return HandEyeSample(
        rigid("base", "effector", hand, f"sample {index}, hand"),
        rigid("camera", "object", seen, f"sample {index}, seen"),
    )


def compose_json(samples: Sequence[HandEyeSample]) -> str:
    """Return samples as JSON, which has no place for the frames' names."""
    _check(samples)
    pairs = [[matrix_rows(sample.hand), matrix_rows(sample.seen)] for sample in samples]
    return f"[{','.join(chr(10) + json.dumps(pair) for pair in pairs)}\n]\n"


def compose_yaml(samples: Sequence[HandEyeSample]) -> str:
    """Return samples as YAML, which has no place for the frames' names."""
    _check(samples)
    text = "".join(
        f"- {_HAND}: [{_listed(sample.hand)}]\n  {_SEEN}: [{_listed(sample.seen)}]\n"
        for sample in samples
    )
    return text or "[]\n"


def _check(samples: Sequence[HandEyeSample]) -> None:
    for name in HandEyeSample._fields:
        check_same_frames([getattr(sample, name) for sample in samples], f"sample {{}}, {name}")


def check_same_frames(transforms: Sequence[Transform], label: str) -> None:
    """Raise ``WRONG_FRAME`` unless all are between the same frames, which the file cannot name.

    ``label``: a transform's name in the error, with ``{}`` for its number.
    """
    for index, transform in enumerate(transforms):
        if (transform.target, transform.source) != (transforms[0].target, transforms[0].source):
            raise Code.WRONG_FRAME.unexpected(
                f"{label.format(index)}: expected {transforms[0].label}, like {label.format(0)}",
                transforms[0].label,
                transform.label,
            )


def _listed(transform: Transform) -> str:
    return ", ".join(real(value) for row in matrix_rows(transform) for value in row)
