"""Serve the pictures of results to clients, as OPC UA's temporary files."""

from __future__ import annotations

import asyncio
import itertools
from typing import TYPE_CHECKING, Any

from asyncua import ua
from asyncua.common.instantiate_util import instantiate

if TYPE_CHECKING:
    from smartcam.outlets._opcua.book import ResultBook
    from smartcam.outlets._opcua.nodes import CameraNodes

MAX_FILES = 32
"""Largest number of files that are open at the same time; further ones are refused."""

MAX_FILE_BYTES = 1 << 26
"""Largest number of bytes of a picture; larger pictures are not transferred."""

MAX_READ_BYTES = 1 << 20
"""Largest number of bytes of one answer to ``Read``."""

FILE_TIMEOUT = 60.0
"""Seconds after a client's last call at which its file is closed."""

_TRANSFER = "ResultManagement.ResultTransfer"


class _OpenFile:
    """A picture that a client reads."""

    def __init__(self, node: Any, data: bytes, timer: asyncio.TimerHandle) -> None:
        self.node, self.data, self.timer = node, data, timer
        self.position = 0


class TransferFiles:
    """The temporary files of a server.

    Args:
        server: server of asyncua.
        own_index: index of the namespace that contains the cameras' nodes.
    """

    def __init__(self, server: Any, own_index: int) -> None:
        self._server, self._own_index = server, own_index
        self._files: dict[int, _OpenFile] = {}
        self._numbers = itertools.count(1)
        self._closing_tasks: set[asyncio.Task[None]] = set()

    async def link(self, nodes: CameraNodes, book: ResultBook) -> None:
        """Link the methods of a camera's ``ResultTransfer``."""

        async def generate(_parent: ua.NodeId, options: Any = None, *_more: Any) -> Any:
            return await self._generate(nodes, book, options)

        async def refuse(_parent: ua.NodeId, *_arguments: Any) -> ua.StatusCode:
            return _status(ua.StatusCodes.BadNotWritable)

        for name, call in (
            ("GenerateFileForRead", generate),
            ("GenerateFileForWrite", refuse),
            ("CloseAndCommit", refuse),
        ):
            self._server.link_method(self._server.get_node(nodes.id(f"{_TRANSFER}.{name}")), call)
        timeout = self._server.get_node(nodes.id(f"{_TRANSFER}.ClientProcessingTimeout"))
        await timeout.write_value(FILE_TIMEOUT * 1000, ua.VariantType.Double)

    async def _generate(self, nodes: CameraNodes, book: ResultBook, options: Any) -> Any:
        result_id = getattr(getattr(options, "Value", None), "Id", None)
        key = getattr(result_id, "Id", result_id)
        kept = book.get(key, nodes.name) if isinstance(key, str) else None
        path = None if kept is None else kept.result.picture
        if path is None:
            return _status(ua.StatusCodes.BadNotFound)
        if len(self._files) >= MAX_FILES:
            return _status(ua.StatusCodes.BadTooManyOperations)
        number = next(self._numbers)
        self._files[number] = file = _OpenFile(None, b"", self._start_timer(number))
        try:
            file.data = await asyncio.to_thread(_read, path)
            file.node = await self._make_node(nodes, number, len(file.data))
        except OSError:
            self._close_file(number)
            return _status(ua.StatusCodes.BadNotFound)
        handle = ua.Variant(number, ua.VariantType.UInt32)
        return [ua.Variant(file.node.nodeid), handle, ua.Variant(ua.NodeId())]

    def _start_timer(self, number: int) -> asyncio.TimerHandle:
        return asyncio.get_running_loop().call_later(FILE_TIMEOUT, self._close_file, number)

    async def _make_node(self, nodes: CameraNodes, number: int, size: int) -> Any:
        root = nodes.id(f"{_TRANSFER}.File{number}")
        await instantiate(
            self._server.get_node(nodes.id(_TRANSFER)),
            self._server.get_node(ua.NodeId(ua.ObjectIds.FileType)),
            nodeid=root,
            bname=ua.QualifiedName(f"File{number}", self._own_index),
            instantiate_optional=False,
        )
        for name, value, value_type in (
            ("Size", size, ua.VariantType.UInt64),
            ("OpenCount", 1, ua.VariantType.UInt16),
            ("Writable", False, ua.VariantType.Boolean),
            ("UserWritable", False, ua.VariantType.Boolean),
        ):
            node = self._server.get_node(ua.NodeId(f"{root.Identifier}.{name}", self._own_index))
            await node.write_value(value, value_type)
        for name, call in self._file_methods(number).items():
            node = self._server.get_node(ua.NodeId(f"{root.Identifier}.{name}", self._own_index))
            self._server.link_method(node, call)
        return self._server.get_node(root)

    def _file_methods(self, number: int) -> dict[str, Any]:
        """Return the methods of a file by their names."""

        def check_handle(method: Any) -> Any:
            async def call(_parent: ua.NodeId, *arguments: ua.Variant) -> Any:
                file = self._files.get(number)
                values = [argument.Value for argument in arguments]
                if file is None or not values or values[0] != number:
                    return _status(ua.StatusCodes.BadInvalidArgument)
                file.timer.cancel()
                file.timer = self._start_timer(number)
                try:
                    return method(file, *values[1:])
                except (TypeError, ValueError):
                    return _status(ua.StatusCodes.BadInvalidArgument)

            return call

        async def open_again(_parent: ua.NodeId, *_arguments: ua.Variant) -> ua.StatusCode:
            return _status(ua.StatusCodes.BadNotSupported)

        def write(_file: _OpenFile, _data: object) -> ua.StatusCode:
            return _status(ua.StatusCodes.BadNotWritable)

        def close(_file: _OpenFile) -> list[ua.Variant]:
            self._close_file(number)
            return []

        return {
            "Open": open_again,
            "Write": check_handle(write),
            "Read": check_handle(_read_bytes),
            "GetPosition": check_handle(_position),
            "SetPosition": check_handle(_set_position),
            "Close": check_handle(close),
        }

    def _close_file(self, number: int) -> None:
        file = self._files.pop(number, None)
        if file is None:
            return
        file.timer.cancel()
        if file.node is not None:
            task = asyncio.get_running_loop().create_task(self._delete(file.node))
            self._closing_tasks.add(task)
            task.add_done_callback(self._closing_tasks.discard)

    async def _delete(self, node: Any) -> None:
        await self._server.delete_nodes([node], recursive=True)

    def close(self) -> None:
        """Close all files."""
        for number in [*self._files]:
            self._close_file(number)


def _read_bytes(file: _OpenFile, length: int) -> list[ua.Variant]:
    if length < 0:
        raise ValueError("a length below 0")
    end = file.position + min(length, MAX_READ_BYTES)
    data, file.position = file.data[file.position : end], min(end, len(file.data))
    return [ua.Variant(data, ua.VariantType.ByteString)]


def _position(file: _OpenFile) -> list[ua.Variant]:
    return [ua.Variant(file.position, ua.VariantType.UInt64)]


def _set_position(file: _OpenFile, position: int) -> list[ua.Variant]:
    file.position = min(max(0, position), len(file.data))
    return []


def _read(path: Any) -> bytes:
    """Return the bytes of a picture.

    Raises:
        OSError: the file no longer exists, or is too large.
    """
    with path.open("rb") as stream:
        data: bytes = stream.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise OSError(f"{path} has more than {MAX_FILE_BYTES} bytes")
    return data


def _status(code: int) -> ua.StatusCode:
    return ua.StatusCode(code)
