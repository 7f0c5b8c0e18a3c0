"""Write ``smartcam/sync.py``: the camera without asyncio has the methods of the one with it.

``python -m scripts.write_sync`` reads the signatures and the first lines of the docstrings of
``Camera``, ``FrameReader`` and ``connect()``. ``tests/test_sync.py`` fails where the module is not
what this script writes. What cannot be written from signatures, such as ``open()`` and Ctrl-C,
stands in ``smartcam/_sync_base.py``.
"""

from __future__ import annotations

import ast
import itertools
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

PACKAGE = Path(__file__).parents[1] / "smartcam"
WRITTEN = PACKAGE / "sync.py"
LINE_LENGTH = 100
"""Characters of a line, as ``[tool.ruff]`` in ``pyproject.toml`` has it."""

Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef


class Source(NamedTuple):
    """A module that is read."""

    text: str
    tree: ast.Module

    def methods(self, name: str) -> list[Function]:
        """Return the public methods of a class, overloads too."""
        (kind,) = (
            node for node in self.tree.body if isinstance(node, ast.ClassDef) and node.name == name
        )
        return [*_functions(kind.body)]

    def functions(self) -> list[Function]:
        """Return the public functions of the module, overloads too."""
        return [*_functions(self.tree.body)]

    def of(self, node: ast.expr | None) -> str:
        """Return an expression as it is written there."""
        return "" if node is None else ast.get_source_segment(self.text, node) or ""


class Face(NamedTuple):
    """A class that is written, and the one whose methods it has.

    Attributes:
        source: the module of the class with asyncio.
        reference: that class as the documents name it.
        held: the attribute that holds an object of it.
        methods: what is written, in this order.
    """

    source: Source
    reference: str
    held: str
    methods: list[Function]


HEAD = '''\
"""Cameras without asyncio: the same methods, which return when they are done.

::

    with smartcam.sync.connect("bvs://192.168.0.10", interpret_as="localizations") as camera:
        print(camera.trigger().value)

One thread of the process has an event loop for all cameras; the calls of any other thread are done
there. Names, outcomes, timeouts and accounts are those of :class:`smartcam.Camera`, from which this
module is written by ``python -m scripts.write_sync``.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, TypeVar, overload

from smartcam._sync_base import SyncCameraBase, SyncFrameReaderBase, SyncSubscription
from smartcam.camera import (
    DEFAULT_MAX_QUEUE,
    DEFAULT_MAX_QUEUE_BYTES,
    DEFAULT_RECONNECT_TIMEOUT,
    DEFAULT_TRIGGER_TIMEOUT,
    FRAME_TIMEOUT,
)
from smartcam.connecting import connect as connect_async
from smartcam.models import ValueT

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable
    from datetime import datetime
    from typing import Literal, Self, Unpack

    from smartcam.camera import FrameEncoding, StreamEncoding
    from smartcam.exceptions import SmartCamError
    from smartcam.fleet import FleetFrame
    from smartcam.frames import Frame
    from smartcam.frames._inside import ReaderStatistics
    from smartcam.interpreters._inside import AnySpec, TypedSpec
    from smartcam.models import (
        CameraEvent,
        Capabilities,
        Localization,
        Result,
        Statistics,
        Status,
    )
    from smartcam.observers import Observer
    from smartcam.settings import CameraOptions, OtherOptions

__all__ = ["SyncCamera", "SyncFrameReader", "SyncSubscription", "connect"]

T = TypeVar("T")
'''

CONNECT_BODY = '''\
    """Return a camera to be opened with ``with`` (or :meth:`SyncCamera.open`).

    Everything is as for :func:`smartcam.connect`. Observers, predicates and interpreters are called
    in the thread of the event loop.

    Raises:
        ConfigurationError: an address or option cannot work; nothing was tried.
    """
    return SyncCamera(connect_async(url, model=model, observers=observers, **options))
'''

CAMERA_HEAD = '''\
class SyncCamera(SyncCameraBase[ValueT]):
    """A :class:`~smartcam.Camera` for programs without asyncio; made by :func:`connect`.

    Any thread may call any method, at the same time as others. A call raises
    :exc:`~smartcam.LocalProtocolError` in an event loop (there the async form is at hand), in a
    predicate or observer, and in a fork of the process that made the camera. Ctrl-C ends any call
    as a cancellation does, of which each method of :class:`~smartcam.Camera` tells.

    Args:
        camera: asynchronous camera that this class wraps, not opened yet.
    """
'''

READER_HEAD = '''\
class SyncFrameReader(SyncFrameReaderBase):
    """A reader of frames: ``for frame in frames``; as :class:`smartcam.frames.FrameReader`."""
'''

WRITTEN_BY_HAND = {"open", "close", "name", "url"}
"""Methods of a camera that ``_sync_base.py`` has."""

READER_METHODS = {"statistics", "newest", "after"}
"""Methods that a reader has: the ``with`` closes it, and the others want an event loop."""

NOTES = {
    "next_result": """\
If the same thread starts what causes the result, subscribe first::

    with camera.results() as results:
        start_conveyor()
        result = results.get(timeout=5)
"""
}
"""Sentences for methods whose docstring needs more than the first line of ``Camera``'s."""


def read(path: str) -> Source:
    """Return a module of smartcam by its path in the package."""
    text = (PACKAGE / path).read_text(encoding="utf-8")
    return Source(text, ast.parse(text))


def written() -> str:
    """Return the module as it has to be."""
    return "\n\n".join(
        [
            HEAD,
            *_connect(read("connecting.py")),
            "\n".join([CAMERA_HEAD, *_methods(_camera())]),
            "\n".join([READER_HEAD, *_methods(_reader())]),
        ]
    )


def _camera() -> Face:
    source = read("camera.py")
    methods = [one for one in source.methods("Camera") if one.name not in WRITTEN_BY_HAND]
    return Face(source, "smartcam.Camera", "_camera", methods)


def _reader() -> Face:
    source = read("frames/_reader.py")
    methods = [one for one in source.methods("FrameReader") if one.name in READER_METHODS]
    return Face(source, "smartcam.frames.FrameReader", "_reader", methods)


def _functions(nodes: Iterable[ast.stmt]) -> Iterator[Function]:
    for node in nodes:
        if isinstance(node, Function) and not node.name.startswith("_"):
            yield node


def _connect(source: Source) -> Iterator[str]:
    """Yield the overloads of ``connect()`` and the function itself."""
    for node in source.functions():
        returns = source.of(node.returns).replace("Camera[", "SyncCamera[")
        head = _head(source, node, returns, "")
        yield head if _is_overload(node) else head + CONNECT_BODY


def _methods(face: Face) -> Iterator[str]:
    """Yield each method of a class."""
    for name, group in itertools.groupby(face.methods, key=lambda node: node.name):
        nodes = [*group]
        if len(nodes) == 1:
            yield _method(face, nodes[0], _sync_type(_returns(face, nodes[0])))
        else:
            for node in nodes[:-1]:
                yield _head(face.source, node, _sync_type(_returns(face, node)), "    ")
            yield _method(face, nodes[-1], "Any", f"{name}: Callable[..., Any] = ")


def _method(face: Face, node: Function, returns: str, binding: str = "") -> str:
    """Return a whole method.

    Args:
        face: the class.
        node: the method with asyncio.
        returns: what it returns without.
        binding: begins a line that takes the method with asyncio by name: overloads are not what
            can be called with arguments of any type.
    """
    is_property = _has_decorator(node, "property")
    decorators = ["    @property\n"] if is_property else []
    called = f"self.{face.held}.{node.name}"
    lines = []
    if binding:
        lines.append(f"        {binding}{called}\n")
        called = node.name
    if _is_context(face, node):
        decorators.append("    @contextlib.contextmanager\n")
        lines.append(_inside(face, node, called))
    elif is_property:
        lines.append(f"        return {called}\n")
    else:
        begin = "        " if returns == "None" else "        return "
        begin += f"self.{_way(face, node)}("
        lines.append(_filled(begin, [called, *_passed(node)], ")"))
    head = _head(face.source, node, returns, "    ")
    return "".join([*decorators, head, _docstring(face, node), *lines])


def _inside(face: Face, node: Function, called: str) -> str:
    """Return the lines that are inside a context of the event loop's thread."""
    is_reader = "[FrameReader]" in _returns(face, node)
    end, given = (") as reader:", "SyncFrameReader(reader, self)") if is_reader else ("):", "self")
    line = _filled("        with self._enter_in_loop(", [called, *_passed(node)], end)
    return f"{line}            yield {given}\n"


def _way(face: Face, node: Function) -> str:
    """Return how a method is called in the event loop's thread."""
    returns = _returns(face, node)
    if isinstance(node, ast.AsyncFunctionDef) or returns.startswith("Coroutine["):
        return "_wait"
    return "_subscribed" if "Subscription[" in returns else "_do"


def _is_context(face: Face, node: Function) -> bool:
    return "AbstractAsyncContextManager[" in _returns(face, node)


def _returns(face: Face, node: Function) -> str:
    return face.source.of(node.returns)


def _sync_type(annotation: str) -> str:
    """Return what a method returns without asyncio."""
    for pattern, replacement in (
        (r"^Coroutine\[Any, Any, (.*)\]$", r"\1"),
        (r"^contextlib\.AbstractAsyncContextManager\[(.*)\]$", r"Generator[\1]"),
        (r"^BatchSubscription\[(.*)\]$", r"SyncSubscription[list[\1]]"),
        (r"^Subscription\[", "SyncSubscription["),
        (r"\bFrameReader\b", "SyncFrameReader"),
    ):
        annotation = re.sub(pattern, replacement, annotation)
    return annotation


def _head(source: Source, node: Function, returns: str, indent: str) -> str:
    """Return ``def`` to ``:``, and an overload whole."""
    is_overload = _is_overload(node)
    decorator = f"{indent}@overload\n" if is_overload else ""
    end = f") -> {returns}:{' ...' if is_overload else ''}"
    return decorator + _filled(f"{indent}def {node.name}(", [*_parameters(source, node)], end)


def _parameters(source: Source, node: Function) -> Iterator[str]:
    """Yield the parameters as they are written."""
    arguments = node.args
    without = [None] * (len(arguments.args) - len(arguments.defaults))
    for one, default in zip(arguments.args, [*without, *arguments.defaults], strict=True):
        yield _parameter(source, one, default)
    if arguments.kwonlyargs:
        yield "*"
    for one, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True):
        yield _parameter(source, one, default)
    if arguments.kwarg is not None:
        yield f"**{_parameter(source, arguments.kwarg, None)}"


def _parameter(source: Source, one: ast.arg, default: ast.expr | None) -> str:
    typed = f"{one.arg}: {source.of(one.annotation)}" if one.annotation else one.arg
    return typed if default is None else f"{typed} = {source.of(default)}"


def _passed(node: Function) -> list[str]:
    """Return the arguments of the call to the method with asyncio."""
    return [
        *(one.arg for one in node.args.args[1:]),
        *(f"{one.arg}={one.arg}" for one in node.args.kwonlyargs),
    ]


def _filled(begin: str, items: list[str], end: str) -> str:
    """Return what stands in brackets on as few lines as ``ruff format`` takes."""
    whole = f"{begin}{', '.join(items)}{end}"
    if len(whole) <= LINE_LENGTH:
        return f"{whole}\n"
    indent = " " * (len(begin) - len(begin.lstrip()))
    inner = f"{indent}    {', '.join(items)}"
    if len(inner) > LINE_LENGTH:
        inner = "\n".join(f"{indent}    {item}," for item in items)
    return f"{begin}\n{inner}\n{indent}{end}\n"


def _docstring(face: Face, node: Function) -> str:
    """Return the beginning of the first line of a docstring, and where the rest stands."""
    told = ast.get_docstring(node)
    if told is None:
        raise ValueError(f"{face.reference}.{node.name} has no docstring")
    first = re.split(r"[;:](?!:)|\.(?: |$)", told.partition("\n")[0], maxsplit=1)[0]
    first = first.replace("``async with``", "``with``")
    is_property = _has_decorator(node, "property")
    # what a colon ends is a type for Sphinx, in the docstring of a property
    role, joint = ("attr", ", as ") if is_property else ("meth", ": ")
    reference = f":{role}:`{face.reference}.{node.name}`"
    note = NOTES.get(node.name, "")
    line = f'        """{first}{joint}{reference}.'
    if len(line) + (0 if note else 3) > LINE_LENGTH:
        line, note = f'        """{first}.', f"As {reference}.\n\n{note}".rstrip() + "\n"
    if not note:
        return f'{line}"""\n'
    return f'{line}\n\n{textwrap.indent(note, " " * 8)}        """\n'


def _is_overload(node: Function) -> bool:
    return _has_decorator(node, "overload")


def _has_decorator(node: Function, name: str) -> bool:
    return any(isinstance(one, ast.Name) and one.id == name for one in node.decorator_list)


if __name__ == "__main__":
    WRITTEN.write_text(written(), encoding="utf-8")
