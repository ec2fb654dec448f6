"""Locate the files of a ROS bag and open a reader for them, with checks before a library reads them."""

import bz2
import re
import sqlite3
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]

from coloc_graph.errors import BagError, RunError
from coloc_graph.exchange.ros_mcap import McapBag
from coloc_graph.run.chunks import MAX_RECORD

#: Message-wise compression, which only rosbags reads.
_BY_MESSAGE = re.compile(rb"^\s*compression_mode:\s*['\"]?message", re.IGNORECASE | re.MULTILINE)
#: Largest metadata.yaml [bytes].
MAX_METADATA = 1024 * 1024


def open_reader(path: Path) -> tuple[Any, bool, list[str]]:
    """Open a reader of a bag.

    Returns
    -------
    tuple
        The reader, True for ROS 2, and sentences on assumptions.

    Raises
    ------
    BagError
        There is no bag at `path`.
    """
    if not path.exists():
        raise BagError(f"{path}: there is no such bag; give a ROS 1 .bag, a ROS 2 folder, or an .mcap")
    notes: list[str] = []
    if path.is_dir():
        files = _storage_files(path)
        if not (path / "metadata.yaml").exists():
            if len(files) > 1 and files[0].suffix == ".db3":
                raise BagError(
                    f"{path}: holds {len(files)} .db3 files and no metadata.yaml, which its recorder did not write; "
                    f"give one of them, as {files[0].name}"
                )
            if not files:
                raise BagError(
                    f"{path}: is a folder without metadata.yaml, .mcap and .db3, so no ROS 2 bag; give a ROS 1 .bag, a "
                    "ROS 2 folder, or an .mcap"
                )
            notes.append(f"{path}: has no metadata.yaml (its recorder was ended); read is {_named(files)}")
            path = files[0]
        elif not files or files[0].suffix == ".db3" or _compressed_by_message(path / "metadata.yaml"):
            return _rosbags(path), True, notes
        if path.suffix != ".db3":
            return _mcap(files, path, notes)
    if path.suffix == ".mcap":
        return _mcap([path], path, notes)
    if path.suffix == ".db3":
        _require_tables(path)
        return _rosbags(path), True, notes
    if path.suffix != ".bag":
        raise BagError(f"{path}: is no bag by its name; give a ROS 1 .bag, a ROS 2 folder, or an .mcap")
    return _ros1(path), False, notes


def _storage_files(folder: Path) -> list[Path]:
    """Message files in a folder, all .mcap or all .db3, in order of their numbers."""
    for suffix in (".mcap", ".db3"):
        if found := sorted((one for one in folder.glob(f"*{suffix}") if one.is_file()), key=_number):
            return found
    return []


def _number(path: Path) -> tuple[int, str]:
    digits = re.search(r"(\d{1,9})$", path.stem)
    return (int(digits[1]) if digits else 0, path.name)


def _named(files: list[Path]) -> str:
    return files[0].name if len(files) == 1 else f"{files[0].name} to {files[-1].name}"


def _compressed_by_message(path: Path) -> bool:
    with path.open("rb") as file:
        text = file.read(MAX_METADATA + 1)
    if len(text) > MAX_METADATA:
        raise BagError(f"{path}: is larger than {MAX_METADATA // 1024} KiB; give the .mcap or .db3 beside it")
    return _BY_MESSAGE.search(text) is not None


def _mcap(files: list[Path], path: Path, notes: list[str]) -> tuple[Any, bool, list[str]]:
    try:
        bag = McapBag(files)
    except RunError as error:
        if "outside of chunks" not in str(error):
            raise BagError(f"{error}".replace("from where it was recorded", "or mend it by `mcap recover`")) from error
        return _rosbags(path), True, notes  # written without chunks, and so without compression
    return bag, True, notes + bag.notes


def _require_tables(path: Path) -> None:
    """Raise `BagError` unless a database has tables of messages and topics; a view could take forever."""
    try:
        database = sqlite3.connect(f"file:{path.absolute().as_posix().replace('?', '%3f')}?mode=ro", uri=True)
        try:
            found = dict(database.execute("SELECT name, type FROM sqlite_master LIMIT 1000"))
        finally:
            database.close()
    except sqlite3.Error as error:
        raise BagError(f"{path}: cannot be read as a ROS bag ({error}); record it again") from error
    if found.get("messages") != "table" or found.get("topics") != "table":
        raise BagError(f"{path}: is a database without tables of messages and topics; give one that ROS 2 recorded")


def _rosbags(path: Path) -> Any:
    from rosbags import rosbag2

    if path.is_dir():
        for one in path.glob("*.db3"):
            _require_tables(one)
    reader = rosbag2.Reader(path)
    reader.open()
    return reader


def _ros1(path: Path) -> Any:
    from rosbags import rosbag1

    reader = rosbag1.Reader(path)
    reader.open()
    for at, chunk in reader.chunks.items():
        bounded = {"bz2": _bunzip, "lz4": _unlz4}.get(_kind(chunk.decompressor))
        if bounded is not None:
            reader.chunks[at] = chunk._replace(decompressor=bounded)
    return reader


def _kind(decompressor: Any) -> str:
    module = str(getattr(decompressor, "__module__", ""))
    return "lz4" if module.startswith("lz4") else "bz2" if module == "bz2" else ""


def _bunzip(data: bytes) -> bytes:
    return _whole(bz2.BZ2Decompressor(), data)


def _unlz4(data: bytes) -> bytes:
    return _whole(lz4.frame.LZ4FrameDecompressor(), data)


def _whole(decompressor: Any, data: bytes) -> bytes:
    found = bytes(decompressor.decompress(data, max_length=MAX_RECORD))
    if not decompressor.eof:
        raise ValueError(f"a chunk of more than {MAX_RECORD} bytes, or one that was cut off")
    return found
