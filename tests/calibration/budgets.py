"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

from smartcam.calibration.formats import SAMPLES, TRAJECTORIES, TRANSFORMS
from tests.budgets.inputs import JSON, PAST_LOOKAHEAD, YAML
from tests.budgets.parser import Make, Parser, fill_text, from_file
from tests.calibration.inside import FORMS, Format, store

_CSV = "#t [s],x [m],y [m],z [m],qx [],qy [],qz [],qw []\n"

_POSES: dict[str, Make] = {
    "YAML: keys": YAML["keys"],
    "YAML: nested brackets": YAML["nested brackets"],
    "YAML: aliases": YAML["aliases"],
    "YAML: a long text": YAML["a long text"],
    "JSON: a list": JSON["a list"],
    "words": fill_text("1 "),
    "a long word": fill_text("1"),
    "quotation marks": fill_text("'' "),
    "a long quotation": fill_text("a", "'", "'"),
    "comments": fill_text("#\n"),
    "nodes": fill_text("<node >", "<launch>"),
    "a node without an end": fill_text("a", "<node "),
    "attributes": fill_text('a="b" ', '<node type="static_transform_publisher" ', ">"),
    "attributes without an end": fill_text('a="', "<node ", ">"),
    "remarks": fill_text("<!---->", "<launch>"),
    "remarks without an end": fill_text("<!--", "<launch>"),
    "arguments of a node": fill_text("1", '<node type="static_transform_publisher" args="', '"/>'),
}

_XML: dict[str, Make] = {
    "XML: elements": fill_text("<a/>", "<opencv_storage>", "</opencv_storage>"),
    "XML: names": fill_text("<a{}>1 2</a{}>", "<opencv_storage>", "</opencv_storage>"),
    "XML: nested elements": fill_text("<a>"),
    "XML: a long text": fill_text("1 ", "<opencv_storage><a>", "</a></opencv_storage>"),
    "XML: attributes": fill_text('b{}="1" ', "<robot><joint ", "/></robot>"),
    "XML: entities": fill_text("&lt;", "<robot>", "</robot>"),
    "XML: joints": fill_text(
        '<joint><parent link="a"/><child link="b{}"/><origin/></joint>', "<robot>", "</robot>"
    ),
}

_POSES |= {
    **_XML,
    "Python: calls": fill_text("f(a=1)\n", "import a\n"),
    "Python: nested calls": fill_text("f(", "import a\n"),
    "Python: signs": fill_text("-", "import a\nb=", "1"),
    "Python: a sum": fill_text("+1", "import a\nb=1"),
    "Python: arguments": fill_text(
        '"1",', "import a\nN(executable='static_transform_publisher', arguments=[", "])"
    ),
}

_CAMERAS: dict[str, Make] = {
    **_XML,
    "lines of numbers": fill_text("1 OPENCV 1 1 1 1 1 1 1 1 1 1\n"),
    "titles": fill_text("a\n1 2 3\n", "[image]\n"),
    "JSON: cameras": fill_text('{"camera_type":"kb4"},', '{"value0":{"intrinsics":[', "1]}}"),
    "JSON: nested lists": JSON["nested lists"],
    "YAML: keys": YAML["keys"],
    "YAML: a list in brackets": YAML["a list in brackets"],
    "coefficients": fill_text(
        "0, ",
        "image_width: 1\nimage_height: 1\ndistortion_model: plumb_bob\ncamera_matrix: {rows: 3, "
        "cols: 3, data: [1,0,0,0,1,0,0,0,1]}\ndistortion_coefficients:\n  rows: 1\n  cols: 9\n"
        "  data: [",
        "]\n",
    ),
    "cameras": fill_text("cam{}: {camera_model: pinhole}\n"),
    "matrices": fill_text(
        "m{}: !!opencv-matrix {rows: 4, cols: 4, dt: d, data: []}\n", "%YAML:1.0\n---\n"
    ),
}

_SAMPLES: dict[str, Make] = {
    "pairs": fill_text(
        "[[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]],[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]],",
        "[",
        "[]]",
    ),
    "a list": JSON["a list"],
    "nested lists": JSON["nested lists"],
    "a number of many digits": JSON["a number of many digits"],
    "pairs of YAML": fill_text(
        "- {effector_wrt_world: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1], "
        "object_wrt_sensor: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}\n"
    ),
}

_TRAJECTORIES: dict[str, Make] = {
    "poses": fill_text("{}.5,1,2,3,0,0,0,1\n", _CSV),
    "remarks": fill_text("#\n"),
    "columns": fill_text("a [s],", "#"),
    "brackets of columns": fill_text("[", "#t "),
    "a long line": fill_text("1,", _CSV),
    "long numbers": fill_text("1,1,2,3,0,0,0," + "1" * 60 + "\n", _CSV),
}


def _stored(inner: Make) -> Make:
    def make(size: int) -> bytes:
        content = {
            "schema": store.SCHEMA,
            "schema_version": "{}.{}".format(*store.SCHEMA_VERSION),
            "kind": "intrinsics",
            "written_at": "",
            "units": {},
            "software": {},
            "context": {},
            "data": json.loads(inner(size)),
        }
        return json.dumps({**content, "sha256": store._digest(content)}).encode()

    return make


def _read_stored(path: Path) -> None:
    from smartcam.calibration import IntrinsicCalibration

    IntrinsicCalibration.load(path)


def _read_between(form: Format[Any], target: str, source: str, path: Path) -> None:
    form.read(path, target, source, unit="m")


_STORED: dict[str, Make] = {
    **{f"JSON: {kind}": make for kind, make in JSON.items()},
    "unknown fields": _stored(fill_text('"k{}":1,', "{", '"z":1}')),
    "views": _stored(fill_text("{},".replace("{}", '{"a":1}'), '{"views":[', "{}]}")),
    "numbers": _stored(fill_text("1,", '{"matrix":[', "1]}")),
}

PARSERS: tuple[Parser, ...] = (
    Parser(
        "calibrations",
        from_file(_read_stored, "a.json"),
        _STORED,
        store.MAX_FILE_BYTES,
        "calibration._files.store.MAX_FILE_BYTES",
    ),
    *(
        Parser(
            f"transforms: {name}",
            from_file(functools.partial(_read_between, form, "robot", "camera"), "a"),
            _POSES,
            form.max_bytes,
            "calibration.formats._file_format.MAX_TEXT_BYTES",
            size=2500,
            short=PAST_LOOKAHEAD,
            needs=("yaml",),
        )
        for name, form in TRANSFORMS.items()
    ),
    *(
        Parser(
            f"samples: {name}",
            from_file(form.read, "a"),
            _SAMPLES,
            form.max_bytes,
            "calibration.formats._file_format."
            + ("MAX_YAML_BYTES" if "yaml" in name else "MAX_FILE_BYTES"),
            size=2500,
            short=PAST_LOOKAHEAD,
            needs=("yaml",),
        )
        for name, form in SAMPLES.items()
    ),
    *(
        Parser(
            f"trajectories: {name}",
            from_file(functools.partial(_read_between, form, "a", "b"), "a"),
            _TRAJECTORIES,
            form.max_bytes,
            "calibration.formats._file_format.MAX_FILE_BYTES",
            size=2500,
            short=PAST_LOOKAHEAD,
        )
        for name, form in TRAJECTORIES.items()
    ),
    *(
        Parser(
            f"cameras: {name}",
            from_file(form.read, "a"),
            _CAMERAS,
            SAMPLES["moveit_yaml"].max_bytes
            if name == "mrcal"
            else form.max_bytes,  # mrcal: beside the solver's inputs
            "calibration.formats."
            + (
                "_file_format.MAX_YAML_BYTES"
                if name == "mrcal"
                else "_cameras.MAX_CAMERA_FILE_BYTES"
            ),
            size=2500,
            short=PAST_LOOKAHEAD,
            needs=("yaml",),
        )
        for name, form in FORMS.items()
    ),
)
