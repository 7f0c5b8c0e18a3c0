"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.geometry._camera_model import (
        COEFFICIENT_COUNTS,
        DistortionModel,
        coefficient_names,
    )
    from smartcam.geometry._checks import check_choice, check_size
    from smartcam.geometry._codes import Code, Remark
    from smartcam.geometry._rigid import (
        IDENTITY,
        Rigid,
        cross_matrix,
        exp_rotation,
        log_rotation,
        right_jacobian,
    )
    from smartcam.geometry._rotations import (
        MAX_COORDINATE,
        Array,
        as_points,
        as_vector,
        check_finite,
        frame_from_axes,
        matrix_from_quaternion,
        not_finite_error,
        quaternion_about_z,
        quaternion_from_matrix,
        quaternion_multiply,
        rotate,
        rotate_ccw,
    )
    from smartcam.geometry._stored import (
        AsList,
        Context,
        Count,
        ExtraKeys,
        Form,
        Keys,
        Matrix3,
        Matrix43,
        NonNegative,
        NullableTriple,
        Number,
        NumberOrNaN,
        Pair,
        PairOrNaN,
        Positive,
        Remarks,
        SheetOffsets,
        Size,
        Stored,
        Triple,
        Vector2,
        Vector3,
        as_array,
        check_counts,
        check_shape,
        invalid_data_error,
        matrix,
        motion,
        motion_from_data,
        motion_to_data,
        row,
        rows,
    )
    from smartcam.geometry._transforms import as_motion

__all__ = [
    "COEFFICIENT_COUNTS",
    "IDENTITY",
    "MAX_COORDINATE",
    "Array",
    "AsList",
    "Code",
    "Context",
    "Count",
    "DistortionModel",
    "ExtraKeys",
    "Form",
    "Keys",
    "Matrix3",
    "Matrix43",
    "NonNegative",
    "NullableTriple",
    "Number",
    "NumberOrNaN",
    "Pair",
    "PairOrNaN",
    "Positive",
    "Remark",
    "Remarks",
    "Rigid",
    "SheetOffsets",
    "Size",
    "Stored",
    "Triple",
    "Vector2",
    "Vector3",
    "as_array",
    "as_motion",
    "as_points",
    "as_vector",
    "check_choice",
    "check_counts",
    "check_finite",
    "check_shape",
    "check_size",
    "coefficient_names",
    "cross_matrix",
    "exp_rotation",
    "frame_from_axes",
    "invalid_data_error",
    "log_rotation",
    "matrix",
    "matrix_from_quaternion",
    "motion",
    "motion_from_data",
    "motion_to_data",
    "not_finite_error",
    "quaternion_about_z",
    "quaternion_from_matrix",
    "quaternion_multiply",
    "right_jacobian",
    "rotate",
    "rotate_ccw",
    "row",
    "rows",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_codes": "Remark Code",
            "_camera_model": "COEFFICIENT_COUNTS DistortionModel coefficient_names",
            "_checks": "check_choice check_size",
            "_rigid": "IDENTITY Rigid cross_matrix exp_rotation log_rotation right_jacobian",
            "_rotations": "Array MAX_COORDINATE as_points as_vector check_finite frame_from_axes "
            "matrix_from_quaternion not_finite_error quaternion_about_z "
            "quaternion_from_matrix quaternion_multiply rotate rotate_ccw",
            "_stored": "AsList Context Count Form Keys Matrix3 Matrix43 NonNegative Number "
            "NumberOrNaN PairOrNaN NullableTriple ExtraKeys Pair Positive Remarks SheetOffsets "
            "Size Stored Triple Vector2 Vector3 as_array check_counts "
            "check_shape matrix motion motion_from_data motion_to_data invalid_data_error "
            "row rows",
            "_transforms": "as_motion",
        },
    )
