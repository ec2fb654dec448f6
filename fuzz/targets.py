"""Targets of fuzzing: every parser of foreign files, messages between robots, and results. One function a target.

A target takes bytes. It may raise `ColocError` (ValueError where its docstring says so): anything else is a finding.
"""

import itertools
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import msgspec

from coloc_graph.backend import checkpoint
from coloc_graph.calibration.corners import read_image
from coloc_graph.calibration.summary import read_covariance
from coloc_graph.calibration.team_file import write_camera
from coloc_graph.errors import RunError
from coloc_graph.exchange.camera_info import read_camera_info
from coloc_graph.exchange.csv_table import read_table
from coloc_graph.exchange.dat_table import read_dat
from coloc_graph.exchange.g2o import read_g2o
from coloc_graph.exchange.jrl import write_jrl
from coloc_graph.exchange.landmarks import read_landmarks
from coloc_graph.exchange.pyfg import write_pyfg
from coloc_graph.exchange.range_graph import factors_of
from coloc_graph.exchange.range_graph_files import read_range_graph
from coloc_graph.exchange.ranges_csv import read_ranges
from coloc_graph.exchange.ros_bag import BagMessage, open_bag
from coloc_graph.exchange.ros_import import import_ros
from coloc_graph.exchange.ros_map import read_map
from coloc_graph.exchange.tracks import TRACKS_HEADER, import_tracks
from coloc_graph.exchange.tum import read_tum
from coloc_graph.results.comparison import of_result
from coloc_graph.results.config import read_options
from coloc_graph.results.folder import read_result
from coloc_graph.robot_io.link import messages
from coloc_graph.run import decode, open_run, read_true_team, read_truth, run_id, schemas
from coloc_graph.run.index import MAGIC
from coloc_graph.simulation import reference_team
from coloc_graph.team import Ranging, read_team, write_team

FOLDER = Path(tempfile.mkdtemp(prefix="fuzz-"))
FILE = FOLDER / "input"
_TEAM = reference_team()
RANGING = msgspec.structs.replace(
    _TEAM, robots=tuple(msgspec.structs.replace(one, ranging=Ranging(range_sigma=0.1)) for one in _TEAM.robots)
)


def written(data: bytes, suffix: str = "") -> Path:
    """Write an input to a file and return its path."""
    path = FILE.with_suffix(suffix)
    path.write_bytes(data)
    return path


def team(data: bytes) -> None:
    """team.toml, read and changed."""
    path = written(data, ".toml")
    found = read_team(path)
    if robots := [one for one in found.robots if one.camera_if_any is not None]:
        write_camera(path, robots[0].name, msgspec.structs.replace(robots[0].camera, noise_px=0.5), FOLDER / "out.toml")


def ros_map(data: bytes) -> None:
    """The map of a bag's topics."""
    if not (FOLDER / "team.toml").exists():
        write_team(reference_team(), FOLDER / "team.toml")
    read_map(written(data, ".toml"))


def run(data: bytes) -> None:
    """A run as a file: the container, its index, and all messages."""
    path = written(data, ".mcap")
    opened = open_run(path)
    run_id(path)
    for robot in opened.team.names:
        for read in (opened.images, opened.detections, opened.odometry, opened.motions, opened.ranges):
            for _ in itertools.islice(read(robot), 1000):
                pass
    read_truth(path)
    read_true_team(path)


def chunk(data: bytes) -> None:
    """A run whose one chunk holds these records, without checksum."""
    body = struct.pack("<QQQII", 0, 2**62, len(data), 0, 0) + struct.pack("<Q", len(data)) + data
    head = struct.pack("<I", 17) + b"coloc-graph-run-1" + struct.pack("<I", 0)
    run(MAGIC + b"".join(struct.pack("<BQ", op, len(one)) + one for op, one in ((1, head), (6, body))))


_DECODERS: tuple[Callable[[memoryview], object], ...] = (
    decode.decode_team,
    lambda data: decode.decode_detections("A", 0, data),
    lambda data: decode.decode_odometry("A", 0, data),
    lambda data: decode.decode_motion("A", 0, data),
    lambda data: decode.decode_ranges("A", 0, data),
    lambda data: decode.decode_stance(0, data),
    lambda data: decode.decode_planes(0, data),
    lambda data: decode.decode_image("A", 0, schemas.RAW_IMAGE, data),
    lambda data: decode.decode_image("A", 0, schemas.COMPRESSED_IMAGE, data),
    lambda data: decode.decode_pose(0, data),
)


def record(data: bytes) -> None:
    """One message of a run, of the kind that the first byte says; `MalformedError` is right."""
    try:
        _DECODERS[data[0] % len(_DECODERS) if data else 0](memoryview(data[1:]))
    except decode.MalformedError as error:
        raise RunError(str(error)) from error


def _bag(data: bytes, suffix: str) -> None:
    with open_bag(written(data, suffix)) as bag:
        for message in itertools.islice(bag.messages(set(bag.topics)), 500):
            bag.stamp(message)
            bag.decode(message)


def bag_mcap(data: bytes) -> None:
    """A ROS 2 bag as MCAP."""
    _bag(data, ".mcap")


def bag_db3(data: bytes) -> None:
    """A ROS 2 bag as SQLite."""
    _bag(data, ".db3")


def bag_ros1(data: bytes) -> None:
    """A ROS 1 bag."""
    _bag(data, ".bag")


MAP = 'team = "team.toml"\n' + "".join(
    f'[[robots]]\nname = "{one}"\nodometry = "/{one}/odom"\ncamera_info = "/{one}/info"\n' for one in "AB"
)


def bag_import(data: bytes) -> None:
    """A whole import of a ROS 2 bag."""
    ros_map(MAP.encode())
    import_ros(written(data, ".mcap"), FOLDER / "input.toml", FOLDER / "out.mcap")


TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo",
          "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage")  # fmt: skip


def cdr(data: bytes) -> None:
    """One message of a ROS 2 bag, of the type that the first byte says."""
    from coloc_graph.exchange.ros_bag import Bag, _standard_types
    from coloc_graph.exchange.ros_images import camera_of, image_of

    global _bag_of_nothing
    if _bag_of_nothing is None:
        reader = type("Empty", (), {"connections": ()})()
        _bag_of_nothing = Bag(Path("bag"), reader, _standard_types(ros2=True), ros2=True)
    kind = TYPES[data[0] % len(TYPES) if data else 0]
    message = BagMessage("/x", kind, 0, data[1:])
    _bag_of_nothing.stamp(message)
    camera = reference_team().robots[0].camera
    if kind.endswith("Image"):
        image_of(_bag_of_nothing, message, "A", 0.0, camera)
    elif kind.endswith("CameraInfo"):
        camera_of(_bag_of_nothing, message, camera, rectified=False)
    else:
        _bag_of_nothing.decode(message)


_bag_of_nothing = None


def camera_info(data: bytes) -> None:
    """The YAML of a camera_info."""
    read_camera_info(written(data, ".yaml"))


def opencv(data: bytes) -> None:
    """A calibration of OpenCV, as YAML or XML."""
    read_camera_info(written(data, ".yml"))


def kalibr(data: bytes) -> None:
    """A camera of Kalibr's chain."""
    read_camera_info(written(data, ".yaml"), chain_camera="cam0")


def _graph(path: Path) -> None:
    """Read a graph with ranges, make its factors, and write it in both formats, each of which is then read."""
    graph = read_range_graph(path)
    factors_of(graph)
    for write, name in ((write_pyfg, "again.pyfg"), (write_jrl, "again.jrl")):
        write(graph, FOLDER / name)
        again = read_range_graph(FOLDER / name)
        assert set(again.names) == set(graph.names) and len(again.ranges) == len(graph.ranges), name


def pyfg(data: bytes) -> None:
    """A factor graph with ranges, PyFG."""
    _graph(written(data, ".pyfg"))


def jrl(data: bytes) -> None:
    """A factor graph with ranges, JRL."""
    _graph(written(data, ".jrl"))


def ranges(data: bytes) -> None:
    """Ranges as CSV."""
    read_ranges(written(data, ".csv"), RANGING, 0.0, 10.0)


def config(data: bytes) -> None:
    """config.toml, by which a run is solved."""
    read_options(written(data, ".toml"))


def tum(data: bytes) -> None:
    """A TUM trajectory, its covariances behind a line of `===`."""
    poses, _, covariances = data.partition(b"===\n")
    beside = FILE.with_suffix(".cov.csv")
    beside.unlink(missing_ok=True)
    if covariances:
        beside.write_bytes(covariances)
    read_tum(written(poses, ".tum"))


def g2o(data: bytes) -> None:
    """A pose graph, strict and lenient."""
    path = written(data, ".g2o")
    read_g2o(path, lenient=True)
    read_g2o(path)


def tracks(data: bytes) -> None:
    """Tracks as CSV, planes and moves behind lines of `===`."""
    if not (FOLDER / "team.toml").exists():
        write_team(reference_team(), FOLDER / "team.toml")
    parts = data.split(b"===\n")
    paths = [FOLDER / f"{name}.csv" for name in ("tracks", "planes", "moves")]
    for path, part in zip(paths, parts, strict=False):
        path.write_bytes(part)
    planes, moves = (path if len(parts) > n else None for n, path in enumerate(paths[1:], start=1))
    import_tracks(FOLDER / "team.toml", paths[0], FOLDER / "out.mcap", planes_path=planes, moves_path=moves)


def table(data: bytes) -> None:
    """A CSV, a .dat of MR.CLAM."""
    path = written(data, ".csv")
    read_dat(path, 4)
    read_table(path, "tracks", TRACKS_HEADER)


def result(data: bytes) -> None:
    """A result: summary.json, config.toml behind a line of `===`."""
    summary, _, config = data.partition(b"===\n")
    folder = FOLDER / "result"
    (folder / "trajectories").mkdir(parents=True, exist_ok=True)
    for name in "ABC":
        (folder / "trajectories" / f"{name}.tum").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    (folder / "summary.json").write_bytes(summary)
    (folder / "config.toml").write_bytes(config)
    found = read_result(folder)
    assert found.team.robots
    of_result(folder, truth=[str(folder / "trajectories")])


def landmarks(data: bytes) -> None:
    """landmarks.csv of a result."""
    read_landmarks(written(data, ".csv"))


def estimator(data: bytes) -> None:
    """A checkpoint."""
    checkpoint.read(written(data))


def calibration(data: bytes) -> None:
    """calibration.json."""
    read_covariance(written(data), reference_team().robots[0].camera)


def image(data: bytes) -> None:
    """An image file."""
    read_image(written(data))


KINDS = (messages.Sample, messages.Wheels, messages.Event, messages.Status, messages.Command, messages.Hold,
          messages.Reply, messages.ClockQuestion, messages.ClockReply)  # fmt: skip


def link(data: bytes) -> None:
    """A message between robots, of the kind that the first byte says, and the record that it is."""
    kind = KINDS[data[0] % len(KINDS) if data else 0]
    message = messages.decode(data[1:], kind)
    if isinstance(message, messages.Sample):
        message.detections("A", 0.0)
    elif isinstance(message, messages.Wheels):
        message.sample("A", 0.0)
    messages.encode(message)


TARGETS: dict[str, Callable[[bytes], None]] = {
    one.__name__: one
    for one in (
        *(team, ros_map, run, chunk, record, bag_mcap, bag_db3, bag_ros1, bag_import, cdr, camera_info, tum, g2o),
        *(opencv, kalibr, pyfg, jrl, ranges, config, tracks, table, result, landmarks, estimator, calibration),
        *(image, link),
    )
}
