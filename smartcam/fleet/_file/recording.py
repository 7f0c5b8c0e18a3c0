"""Define the section of a fleet file on recording in the agent's process."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from smartcam._file_values import Age, Patterns, Size, matches_any
from smartcam.fleet._file.ros import Fields

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


class RecordSection(Fields):
    """Recording beside the agent: consecutive files for each camera, in one folder."""

    folder: str = Field(
        "recordings",
        min_length=1,
        description="folder of the files, relative to this file; made if missing",
    )
    size: Size = Field(1e8, description="size at which a camera's next file starts, such as 100 MB")
    age: Age = Field(3600.0, description="time after which the next file starts, such as 1 h, 1 d")
    keep: Size = Field(
        1e10,
        description="largest size of all files; the oldest are deleted, such as 10 GB",
    )
    cameras: Patterns = Field(
        ("**",),
        description="cameras that are recorded: names, * for one part of a name, ** for any number",
    )
    messages: bool = Field(
        True,
        description="record the messages of the protocol, too; without them a replay has only "
        "results and statuses",
    )
    pictures: Literal["none", "judged", "all"] = Field(
        "none",
        description="record pictures of cameras with frames, too: 'none'; 'judged': the picture of "
        "each result; 'all'. With 'judged' and 'all', the device streams all the time",
    )

    def chooses(self, camera: str) -> bool:
        """Return True if a camera of this name is recorded."""
        return matches_any(self.cameras, camera)

    def path(self, folder: Path) -> Path:
        """Return the folder of the files.

        Args:
            folder: folder of the fleet file.
        """
        return folder / Path(self.folder).expanduser()


def record_mistakes(
    section: RecordSection, folder: Path, with_frames: Iterable[str]
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the mistakes in the section: the keys that lead to the field, and a text.

    Args:
        section: section of a fleet file.
        folder: folder of the fleet file.
        with_frames: names of the cameras with frames.
    """
    recorded = any(name.endswith("/**") or section.chooses(name) for name in with_frames)
    if section.pictures != "none" and not recorded:
        yield (
            ("record", "pictures"),
            f"pictures: {section.pictures} needs a recorded camera with the key frames or "
            "software; there is none",
        )
    if section.keep < 2 * section.size:
        yield (
            ("record", "keep"),
            f"expected twice the size of a file, {2 * section.size:g} bytes, or more; "
            f"got {section.keep:g}",
        )
    path = section.path(folder)
    if path.exists() and not path.is_dir():
        yield ("record", "folder"), f"{path} is there, and is no folder"
