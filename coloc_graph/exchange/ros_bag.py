"""Read ROS bags without ROS: ROS 1 `.bag`; ROS 2 folders, `.mcap`, `.db3`.

Only standard messages are read, whose definitions are the same in every distribution: definitions in the bag are not
needed, and those of other messages do no harm.
"""

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coloc_graph.errors import BagError, ColocError
from coloc_graph.exchange.ros_files import open_reader
from coloc_graph.input_file import shortened
from coloc_graph.run.schemas import to_seconds

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
RANGE = "sensor_msgs/msg/Range"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"
OLD_TF = "tf/msg/tfMessage"

NOT_INSTALLED = "ROS bags need rosbags, which is not installed here: pip install 'coloc-graph[ros]'"
#: What mends a bag that was cut off, by the ending of its name.
REMEDIES = {".bag": "`rosbag reindex`", ".mcap": "`mcap recover`"}


@dataclass(frozen=True)
class Topic:
    """Topic of a bag: its types (normally one) as `package/msg/Type`, and its number of messages."""

    name: str
    types: tuple[str, ...]
    count: int


@dataclass(frozen=True, eq=False)
class BagMessage:
    """Message as it is in the bag, with its time of reception [ns]."""

    topic: str
    type: str
    received: int
    data: bytes


def full_name(topic: str) -> str:
    """Name of a topic with one leading slash, as ROS resolves it without a namespace."""
    return "/" + topic.lstrip("/")


class Bag:
    """Open bag, made by `open_bag`."""

    def __init__(self, path: Path, reader: Any, store: "Typestore", *, ros2: bool, notes: Sequence[str] = ()) -> None:
        self.path, self.ros2, self.notes = path, ros2, tuple(notes)
        self._reader, self._store = reader, store
        by_name: dict[str, list[Any]] = {}
        for connection in reader.connections:
            by_name.setdefault(full_name(connection.topic), []).append(connection)
        self.topics: Mapping[str, Topic] = {
            name: Topic(name, tuple(sorted({one.msgtype for one in every})), sum(one.msgcount for one in every))
            for name, every in sorted(by_name.items())
        }

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Yield messages of some topics in order of reception."""
        wanted = [one for one in self._reader.connections if full_name(one.topic) in topics]
        for one in wanted:
            self._require_standard(one)
        if not wanted:
            return
        last: BagMessage | None = None
        messages = self._reader.messages(connections=wanted)
        while True:
            with _understood(self.path, _after(last)):
                found = next(messages, None)
            if found is None:
                return
            connection, received, data = found
            last = BagMessage(full_name(connection.topic), connection.msgtype, received, bytes(data))
            yield last

    def decode(self, message: BagMessage) -> Any:
        """Decode a message to an object with the fields of its type, the same for ROS 1 and ROS 2."""
        kind = TF if message.type == OLD_TF else message.type
        read = self._store.deserialize_cdr if self.ros2 else self._store.deserialize_ros1
        if self.ros2 and kind == RANGE:
            with suppress(Exception):  # before ROS 2 Jazzy it ended without a variance
                return read(message.data + bytes(4), kind)
        try:
            return read(message.data, kind)
        except Exception as error:  # of a damaged message rosbags raises whatever it stumbles over
            raise self.error(message, f"is not a {message.type} ({shortened(error)}); record the bag again") from error

    def stamp(self, message: BagMessage) -> int:
        """Header stamp of a message that begins with a header [ns]; 0 if it is not set."""
        try:
            if not self.ros2:  # after a sequence number
                seconds, rest = struct.unpack_from("<II", message.data, 4)
            else:  # after CDR's header, which says who is first of a number's bytes
                seconds, rest = struct.unpack_from("<iI" if message.data[1] & 1 else ">iI", message.data, 4)
        except (struct.error, IndexError) as error:
            raise self.error(message, f"is too short for a {message.type}; record the bag again") from error
        return int(seconds) * 1_000_000_000 + int(rest)

    def error(self, message: BagMessage, what: str) -> BagError:
        """Return the error for a wrong message."""
        return BagError(
            f"{self.path}: the message of {message.topic} received at {to_seconds(message.received)} s {what}"
        )

    def _require_standard(self, connection: Any) -> None:
        """Raise `BagError` if a bag defines a standard message differently."""
        kind = connection.msgtype
        if kind == OLD_TF or not connection.digest or kind not in self._store.fielddefs:
            return
        known = self._store.hash_rihs01(kind) if self.ros2 else self._store.generate_msgdef(kind)[1]
        if connection.digest not in (known, *self._before_jazzy(kind), "*"):
            raise BagError(
                f"{self.path}: {connection.topic} has messages of a {kind} that is not the standard one "
                f"({connection.digest}); record the standard message"
            )

    def _before_jazzy(self, kind: str) -> tuple[str, ...]:
        """Digest of an older standard message that `decode` takes too."""
        from rosbags.typesys import Stores, get_typestore

        return (get_typestore(Stores.ROS2_HUMBLE).hash_rihs01(kind),) if self.ros2 and kind == RANGE else ()


@contextmanager
def open_bag(path: str | Path) -> Iterator[Bag]:
    """Open a bag for reading; `BagError` if there is none, it was cut off, or rosbags is not installed."""
    path = Path(path)
    try:
        import rosbags  # noqa: F401
    except ImportError as error:
        raise BagError(NOT_INSTALLED) from error
    with _understood(path):
        reader, ros2, notes = open_reader(path)
    try:
        with _understood(path):  # a database may have topics without a name
            bag = Bag(path, reader, _standard_types(ros2=ros2), ros2=ros2, notes=notes)
        yield bag
    finally:
        reader.close()


def _standard_types(*, ros2: bool) -> "Typestore":
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if ros2:
        return get_typestore(Stores.LATEST)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return store


@contextmanager
def _understood(path: Path, where: str = "") -> Iterator[None]:
    """Convert any exception of rosbags on a damaged bag to one sentence."""
    try:
        yield
    except ColocError:
        raise
    except PermissionError:
        raise
    except Exception as error:  # struct, lz4, sqlite, assertions: it raises what it stumbles over
        remedy = REMEDIES.get(path.suffix, "`ros2 bag reindex`")
        what = shortened(error).rstrip(".") or type(error).__name__
        raise BagError(
            f"{path}: cannot be read as a ROS bag{where} ({what}); a bag that was cut off is mended by {remedy}"
        ) from error


def _after(last: BagMessage | None) -> str:
    return "" if last is None else f" after the message of {last.topic} at {to_seconds(last.received)} s"
