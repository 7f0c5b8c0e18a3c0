"""Applications, their values and generators; the tangram table."""

from __future__ import annotations

import itertools
import math
import struct
from typing import Any

import pytest
from pydantic import ValidationError

from smartcam.emulator import (
    Application,
    EmulatedCamera,
    Run,
    TablePose,
    TableScene,
    register_generator,
)
from smartcam.emulator._inside import PIECES, TABLE_SIZE, Observation, find_generator, wrap_number
from smartcam.exceptions import ConfigurationError
from smartcam.layout import Layout
from tests.emulator.builtins import BUILTIN_APPLICATIONS, LOCALIZATIONS
from tests.emulator.inside import generator_names


def container(application: Application, **options: Any) -> bytes:
    given: dict[str, Any] = {"number": 5, "run_index": 0, "time": 0.0, "scene": TableScene()}
    data = application.container(**{**given, **options})
    assert data is not None
    return data


def builtin(number: int) -> Application:
    return next(app for app in BUILTIN_APPLICATIONS if app.id == number)


# ---------------------------------------------------------------------- built-in


def test_builtin_ids_and_who_waits_for_triggers() -> None:
    assert {app.id: app.triggered for app in BUILTIN_APPLICATIONS} == {
        1: True,
        3: True,
        7: True,
        9: False,
        21: True,
    }


def test_builtin_21_is_the_published_vector() -> None:
    assert container(builtin(21)) == b"Hello World" + bytes(9)


def test_builtin_3_is_the_derived_vector() -> None:
    expected = "ff 02 00 00 00 00 00 cb 42 00 00 50 c0 41 42 43 00 00 00 00 00"
    assert container(builtin(3)) == bytes.fromhex(expected)


def test_builtin_1_has_a_short_a_full_and_an_empty_text() -> None:
    data = container(builtin(1))
    assert len(data) == 150
    texts = [data[start : start + 50].rstrip(b"\0") for start in (0, 50, 100)]
    assert [len(text) for text in texts] == [12, 50, 0]


def test_builtin_7_is_near_the_truth() -> None:
    scene = TableScene(seed=1)
    data = container(builtin(7), scene=scene)
    assert len(data) == 7 * 70
    for start in range(0, len(data), 70):
        name, quality, photo, x, y, theta = struct.unpack_from("<50sfifff", data, start)
        truth = scene.pieces[name.rstrip(b"\0").decode()]
        assert (x, y) == pytest.approx(truth[:2], abs=4e-4)
        assert theta == pytest.approx(truth.theta, abs=0.02)
        assert photo == 0
        assert 0.9 < quality <= 1.0


def test_builtin_9_sends_its_runs_number() -> None:
    assert container(builtin(9), number=258) == bytes.fromhex("02 01 00 00")
    assert container(builtin(9), number=258, byte_order="big") == bytes.fromhex("00 00 01 02")


def test_builtin_9_number_beyond_int32_starts_over() -> None:
    assert container(builtin(9), number=0x80000000) == bytes.fromhex("00 00 00 80")


# ---------------------------------------------------------------------- values


def test_container_without_send_results_is_none() -> None:
    assert Application(id=2).container(number=0, run_index=0, time=0.0, scene=TableScene()) is None


@pytest.mark.parametrize(
    ("fields", "runs"),
    [
        ({"layout": "n: uint8", "constant": [1]}, 1),
        ({"layout": "n: uint8", "cycle": [[1], [2], [1]]}, 3),
        ({"layout": "n: uint8 @sequence", "constant": [1]}, None),
        ({"layout": "n: uint8", "generator": "sequence"}, None),
        ({}, None),
    ],
)
def test_period_is_known_where_a_run_changes_nothing(
    fields: dict[str, Any], runs: int | None
) -> None:
    assert Application(id=2, **fields).repeat_after == runs


def test_container_cycle_goes_round() -> None:
    app = Application(id=2, layout="n: uint8", cycle=[{"n": 1}, [2], {"n": 3}])
    assert b"".join(container(app, run_index=index) for index in range(7)) == b"\1\2\3\1\2\3\1"


def test_container_slots_are_filled_with_zeros() -> None:
    app = Application(id=2, layout="(n: uint8)*", constant=[{"n": 1}], slots=4)
    assert container(app) == b"\1\0\0\0"


def test_container_sequence_field_gets_the_number_beside_a_constant() -> None:
    app = Application(id=2, layout="n: uint8 @sequence, x: uint8", constant={"n": 0, "x": 9})
    assert container(app, number=258) == b"\x02\x09"


def test_container_layout_object_is_taken() -> None:
    app = Application(id=2, layout=Layout("n: uint8"), constant={"n": 7})  # type: ignore[arg-type]
    assert app.layout == "n: uint8"
    assert container(app) == b"\7"


def test_container_generator_function_sees_the_run() -> None:
    seen: list[Run] = []

    def generate(run: Run) -> dict[str, Any]:
        seen.append(run)
        return {"n": run.number}

    app = Application(id=2, layout="n: int32", generator=generate, parameters={"a": 1})
    assert len(seen) == 1
    container(app, number=3, run_index=2, time=1.5)
    assert seen[-1][:3] == (3, 2, 1.5)
    assert seen[-1].parameters == {"a": 1}
    assert seen[-1].layout == Layout("n: int32")
    assert seen[-1].input is None


def test_container_of_more_than_64_kb_is_refused() -> None:
    with pytest.raises(ValidationError, match="at most 65536 bytes, these values make 65537"):
        Application(id=2, layout="a: uint8, b: string[65535], c: uint8", constant=[1, "", 2])


# ---------------------------------------------------------------------- generators


def test_tangram_units_fields_and_pieces_as_the_layout_says() -> None:
    app = Application(
        id=2,
        layout="(x: real64 mm, feature_id: string[20])*",
        generator="tangram",
        parameters={"pieces": ["square", "nothing", "medium_triangle"]},
    )
    rows = list(struct.iter_unpack("<d20s", container(app, scene=TableScene(pixel_noise=0.0))))
    assert rows == [
        (pytest.approx(240.0), b"square".ljust(20, b"\0")),
        (pytest.approx(150.0), b"medium_triangle".ljust(20, b"\0")),
    ]


def test_tangram_pixels_are_the_cameras() -> None:
    scene = TableScene(pixel_noise=0.0)
    app = Application(
        id=2,
        layout="x: real64, y: real64, theta: real64",
        generator="tangram_pixels",
        parameters={"pieces": ["square"]},
    )
    values = struct.unpack("<ddd", container(app, scene=scene))
    assert values == pytest.approx(scene.to_pixels(scene.pieces["square"]))


def test_tangram_nothing_seen_is_zeros_or_no_record() -> None:
    scene = TableScene()
    scene.pieces = {}
    one = Application(id=2, layout="feature_id: string[20], x: real32", generator="tangram")
    assert container(one, scene=scene) == bytes(24)
    many = Application(id=2, layout=LOCALIZATIONS, generator="tangram", slots=8)
    assert container(many, scene=scene) == bytes(8 * 70)


def test_tangram_layout_with_a_field_it_does_not_have_is_refused() -> None:
    with pytest.raises(ValidationError, match="missing: speed"):
        Application(id=2, layout="(x: real32, speed: real32)*", generator="tangram")


@pytest.mark.parametrize(
    ("layout", "parameters", "expected"),
    [
        ("n: uint8, b: bool, s: string[2]", {}, "05 00 00 00"),
        ("b: bool, n: uint8", {"field": "n"}, "00 05"),
        ("b: bool, n: uint8 @sequence", {}, "00 05"),
        ("x: real32", {}, "00 00 a0 40"),
        ("n: uint8 @sequence, (b: uint8)*", {}, "05 00"),
        ("(n: uint8, b: uint8)*", {}, "05 00"),
    ],
)
def test_sequence_puts_the_number_into_its_field(
    layout: str, parameters: dict[str, Any], expected: str
) -> None:
    app = Application(id=2, layout=layout, generator="sequence", parameters=parameters)
    assert container(app, number=5) == bytes.fromhex(expected)


def test_input_echoes_fields_of_the_same_names() -> None:
    app = Application(
        id=2, layout="b: uint8, a: uint8, c: uint8", input="a: uint8, b: uint8", generator="input"
    )
    assert container(app, values={"a": 1, "b": 2, "z": 9}) == b"\2\1\0"
    assert container(app) == b"\0\0\0"
    listed = Application(id=2, layout="(a: uint8)*", input="a: uint8", generator="input")
    assert container(listed, values={"a": 1}) == b"\1"


def test_wrap_number_takes_what_the_field_holds() -> None:
    small, signed, real = Layout("a: uint8, b: int8, c: real32").fields
    assert [wrap_number(small, n) for n in (0, 255, 256)] == [0, 255, 0]
    assert [wrap_number(signed, n) for n in (127, 128, 256)] == [127, -128, 0]
    assert wrap_number(real, 300) == 300


def test_register_generator_can_be_named_and_not_taken() -> None:
    def seven(run: Run) -> list[int]:
        return [7]

    register_generator("test_seven", seven)
    register_generator("test_seven", seven)
    assert "test_seven" in generator_names()
    assert find_generator("test_seven") is seven
    assert container(Application(id=2, layout="n: uint8", generator="test_seven")) == b"\7"
    with pytest.raises(ConfigurationError, match="'tangram' is there already"):
        register_generator("tangram", seven)


def test_default_processing_time_gives_way_to_the_rate() -> None:
    assert Application(id=2, rate=1000).rate == 1000


# ---------------------------------------------------------------------- what is wrong


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"id": 0}, "id: Input should be greater than or equal to 1"),
        ({"id": 1 << 32}, "id: Input should be less than or equal to 4294967295"),
        ({"colour": 1}, "colour: Extra inputs are not permitted"),
        ({"rate": 0}, "rate: Input should be greater than or equal to 0.0001"),
        ({"rate": 20, "processing_time": 0.06}, "a run of 0.06 s does not fit a rate of 20"),
        ({"load_time": -1}, "load_time: Input should be greater than or equal to 0"),
        ({"layout": "n: uint8"}, "a layout needs values: constant, cycle or generator"),
        ({"constant": {"n": 1}}, "constant needs a layout"),
        (
            {"layout": "n: uint8", "constant": [1], "generator": "input"},
            "values come from one place, not from constant and generator",
        ),
        ({"layout": "n: uint9", "constant": [1]}, "layout: .*uint9"),
        ({"layout": "n: uint8", "constant": {"n": 300}}, "expected 0 to 255, got 300"),
        ({"layout": "n: uint8", "cycle": []}, "cycle: List should have at least 1 item"),
        ({"layout": "n: uint8", "cycle": [[1], ["x"]]}, "cycle.1: .*got 'x'"),
        ({"layout": "n: uint8", "constant": [1], "slots": 3}, "slots= is for layouts with"),
        ({"layout": "n: uint8", "generator": "tungram"}, "'tungram' is unknown; known are input"),
        ({"layout": "n: uint8", "generator": lambda run: 1 / 0}, "generator failed: ZeroDivision"),
        ({"input": "(a: uint8)*"}, "input: input data is one record"),
        ({"input": "a: what"}, "what"),
    ],
)
def test_make_application_wrong_field_is_named(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError, match=f"(?s)application .*{text}"):
        EmulatedCamera([{"id": 5, **fields}])


def test_make_application_without_an_id() -> None:
    with pytest.raises(ConfigurationError, match=r"application \?: id: Field required"):
        EmulatedCamera([{}])


def test_make_application_takes_an_application_as_it_is() -> None:
    app = builtin(3)
    assert EmulatedCamera([app], builtins=False).device.applications[3] is app


# ----------------------------------------------------------------------
# The tangram table and its camera.


NAMES = [
    "big_triangle_1",
    "big_triangle_2",
    "medium_triangle",
    "small_triangle_1",
    "small_triangle_2",
    "square",
    "parallelogram",
]


def test_pieces_lie_apart_on_the_table() -> None:
    assert list(PIECES) == NAMES
    for pose in PIECES.values():
        assert 0.03 < pose.x < TABLE_SIZE[0] - 0.03
        assert 0.03 < pose.y < TABLE_SIZE[1] - 0.03
    for one, other in itertools.combinations(PIECES.values(), 2):
        assert math.dist(one[:2], other[:2]) > 0.05


@pytest.mark.parametrize("y_down", [False, True])
@pytest.mark.parametrize("rotation", [0.0, 0.3, -3.0])
def test_to_table_without_noise_is_the_inverse_of_to_pixels(rotation: float, y_down: bool) -> None:
    scene = TableScene(scale=2500.0, offset=(12.0, -7.0), rotation=rotation, y_down=y_down)
    for name, pose in PIECES.items():
        seen = Observation(name, *scene.to_pixels(pose), quality=1.0)
        assert scene.to_table(seen) == pytest.approx(pose, abs=1e-12)


def test_to_pixels_scales_turns_and_shifts() -> None:
    scene = TableScene(scale=1000.0, offset=(10.0, 20.0), rotation=math.pi / 2)
    u, v, theta = scene.to_pixels(TablePose(0.1, 0.0, 0.5))
    assert (u, v, theta) == pytest.approx((10.0, 120.0, 0.5 + math.pi / 2))


def test_to_pixels_y_down_mirrors_v_and_theta() -> None:
    scene = TableScene(scale=1000.0, offset=(0.0, 500.0), rotation=0.0, y_down=True)
    assert scene.to_pixels(TablePose(0.0, 0.1, 0.5)) == pytest.approx((0.0, 400.0, -0.5))


def test_measure_lies_within_tenths_of_a_millimetre_of_the_truth() -> None:
    scene = TableScene(seed=7)
    for _ in range(50):
        found = scene.measure()
        assert [seen.name for seen in found] == NAMES
        for seen in found:
            pose, truth = scene.to_table(seen), scene.pieces[seen.name]
            assert math.dist(pose[:2], truth[:2]) < 0.0004
            assert abs(pose.theta - truth.theta) < 0.02
            assert 0.0 <= seen.u < 1280.0
            assert 0.0 <= seen.v < 1024.0
            assert 0.95 <= seen.quality <= 1.0


def test_measure_same_seed_same_observations() -> None:
    assert TableScene(seed=3).measure() == TableScene(seed=3).measure()
    assert TableScene(seed=3).measure() != TableScene(seed=4).measure()


def test_measure_without_noise_is_exact() -> None:
    scene = TableScene(pixel_noise=0.0)
    for seen in scene.measure():
        assert scene.to_table(seen) == pytest.approx(scene.pieces[seen.name], abs=1e-12)


def test_measure_sees_a_moved_piece() -> None:
    scene = TableScene(pixel_noise=0.0)
    scene.pieces = {"square": TablePose(0.1, 0.2, math.pi)}
    (seen,) = scene.measure()
    assert scene.to_table(seen)[:2] == pytest.approx((0.1, 0.2))
    assert abs(scene.to_table(seen).theta) == pytest.approx(math.pi)
    assert scene.pieces is not TableScene().pieces


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"scale": 0.0}, "scale: .* got 0.0"),
        ({"scale": float("inf")}, "scale: .* got inf"),
        ({"pixel_noise": -1.0}, "pixel_noise: .* got -1.0"),
        ({"pixel_noise": float("nan")}, "pixel_noise: .* got nan"),
    ],
)
def test_scene_impossible_camera_is_refused(options: dict[str, float], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        TableScene(**options)  # type: ignore[arg-type]  # one keyword each
