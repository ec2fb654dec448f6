"""Targets of fuzzing: every parser of foreign files, messages between robots, and results. One function a target.

A target takes bytes. It may raise `ColocError` (ValueError where its docstring says so): anything else is a finding.
"""

import itertools
import shutil
import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import gtsam
import msgspec
import numpy as np

from coloc_graph.backend import checkpoint
from coloc_graph.calibration.corners import read_image
from coloc_graph.calibration.summary import read_covariance
from coloc_graph.calibration.team_file import write_camera
from coloc_graph.errors import RunError
from coloc_graph.exchange.camera_info import camera_info_text, read_camera_info
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
from coloc_graph.exchange.tum import read_tum, write_tum
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.results.comparison import of_result
from coloc_graph.results.config import CONFIG, read_options, write_config
from coloc_graph.results.folder import read_result
from coloc_graph.robot_io.link import messages
from coloc_graph.run import decode, open_run, read_true_team, read_truth, run_id, schemas
from coloc_graph.run.index import MAGIC
from coloc_graph.simulation import reference_team, simulate
from coloc_graph.team import Ranging, read_team, write_team

FOLDER = Path(tempfile.mkdtemp(prefix="fuzz-"))
FILE = FOLDER / "input"
_TEAM = reference_team()
RANGING = msgspec.structs.replace(
    _TEAM, robots=tuple(msgspec.structs.replace(one, ranging=Ranging(range_sigma=0.1)) for one in _TEAM.robots)
)


def _file(data: bytes, suffix: str = "") -> Path:
    path = FILE.with_suffix(suffix)
    path.write_bytes(data)
    return path


def team(data: bytes) -> None:
    """team.toml, read and changed."""
    path = _file(data, ".toml")
    found = read_team(path)
    if robots := [one for one in found.robots if one.camera_if_any is not None]:
        write_camera(path, robots[0].name, msgspec.structs.replace(robots[0].camera, noise_px=0.5), FOLDER / "out.toml")


def ros_map(data: bytes) -> None:
    """The map of a bag's topics."""
    if not (FOLDER / "team.toml").exists():
        write_team(reference_team(), FOLDER / "team.toml")
    read_map(_file(data, ".toml"))


def run(data: bytes) -> None:
    """A run as a file: the container, its index, and all messages."""
    path = _file(data, ".mcap")
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
    with open_bag(_file(data, suffix)) as bag:
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
    import_ros(_file(data, ".mcap"), FOLDER / "input.toml", FOLDER / "out.mcap")


_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo",
          "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage")  # fmt: skip


def cdr(data: bytes) -> None:
    """One message of a ROS 2 bag, of the type that the first byte says."""
    from coloc_graph.exchange.ros_bag import Bag, _standard_types
    from coloc_graph.exchange.ros_images import camera_of, image_of

    global _bag_of_nothing
    if _bag_of_nothing is None:
        reader = type("Empty", (), {"connections": ()})()
        _bag_of_nothing = Bag(Path("bag"), reader, _standard_types(ros2=True), ros2=True)
    kind = _TYPES[data[0] % len(_TYPES) if data else 0]
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
    read_camera_info(_file(data, ".yaml"))


def opencv(data: bytes) -> None:
    """A calibration of OpenCV, as YAML or XML."""
    read_camera_info(_file(data, ".yml"))


def kalibr(data: bytes) -> None:
    """A camera of Kalibr's chain."""
    read_camera_info(_file(data, ".yaml"), chain_camera="cam0")


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
    _graph(_file(data, ".pyfg"))


def jrl(data: bytes) -> None:
    """A factor graph with ranges, JRL."""
    _graph(_file(data, ".jrl"))


def ranges(data: bytes) -> None:
    """Ranges as CSV."""
    read_ranges(_file(data, ".csv"), RANGING, 0.0, 10.0)


def config(data: bytes) -> None:
    """config.toml, by which a run is solved."""
    read_options(_file(data, ".toml"))


def tum(data: bytes) -> None:
    """A TUM trajectory, its covariances behind a line of `===`."""
    poses, _, covariances = data.partition(b"===\n")
    beside = FILE.with_suffix(".cov.csv")
    beside.unlink(missing_ok=True)
    if covariances:
        beside.write_bytes(covariances)
    read_tum(_file(poses, ".tum"))


def g2o(data: bytes) -> None:
    """A pose graph, strict and lenient."""
    path = _file(data, ".g2o")
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
    path = _file(data, ".csv")
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
    read_landmarks(_file(data, ".csv"))


def estimator(data: bytes) -> None:
    """A checkpoint."""
    checkpoint.read(_file(data))


def calibration(data: bytes) -> None:
    """calibration.json."""
    read_covariance(_file(data), reference_team().robots[0].camera)


def image(data: bytes) -> None:
    """An image file."""
    read_image(_file(data))


_KINDS = (messages.Sample, messages.Wheels, messages.Event, messages.Status, messages.Command, messages.Hold,
          messages.Reply, messages.ClockQuestion, messages.ClockReply)  # fmt: skip


def link(data: bytes) -> None:
    """A message between robots, of the kind that the first byte says, and the record that it is."""
    kind = _KINDS[data[0] % len(_KINDS) if data else 0]
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
        *(
            opencv,
            kalibr,
            pyfg,
            jrl,
            ranges,
            config,
            tracks,
            table,
            result,
            landmarks,
            estimator,
            calibration,
            image,
            link,
        ),
    )
}


def seeds(name: str) -> Iterator[bytes]:
    """Real inputs of a target, small."""
    yield from _SEEDS.get(name, lambda: iter((b"",)))()


def _of_team() -> Iterator[bytes]:
    write_team(reference_team(), FOLDER / "seed.toml")
    yield (FOLDER / "seed.toml").read_bytes()


def _simulated() -> Path:
    path = FOLDER / "seed.mcap"
    if not path.exists():
        simulate("single-step", path, depth="tracks", points=8)
    return path


def _of_run() -> Iterator[bytes]:
    yield _simulated().read_bytes()
    yield from (one.read_bytes() for one in sorted(Path("tests/run/conformance/run").glob("*.mcap")))


def _of_chunk() -> Iterator[bytes]:
    from coloc_graph.run.chunks import decompressed
    from coloc_graph.run.index import build_index

    for path in map(Path("tests/run/conformance/run").joinpath, ("minimal.mcap", "everything.mcap")):
        index = build_index(path)
        with path.open("rb") as file:
            yield from (decompressed(path, file, one) for one in index.chunks)


def _of_record() -> Iterator[bytes]:
    from coloc_graph.run.chunks import messages as in_chunk
    from coloc_graph.run.index import build_index

    kinds = {"Team": 0, "Detections": 1, "Odometry": 2, "Motion": 3, "Ranges": 4, "Stance": 5, "Planes": 6,
             "RawImage": 7, "CompressedImage": 8, "PoseInFrame": 9}  # fmt: skip
    for path in map(Path("tests/run/conformance/run").joinpath, ("minimal.mcap", "everything.mcap")):
        index = build_index(path)
        with path.open("rb") as file:
            for chunk_info in index.chunks:
                for one in in_chunk(path, file, chunk_info):
                    kind = kinds[index.channels[one.channel].schema.rpartition(".")[2]]
                    yield bytes([kind]) + bytes(one.data)


def _of_bag(kind: str) -> Callable[[], Iterator[bytes]]:
    def made() -> Iterator[bytes]:
        import sys

        sys.path.insert(0, "tests/support")
        import ros_bags

        shutil.rmtree(FOLDER / "bags", ignore_errors=True)
        (FOLDER / "bags").mkdir()
        camera = reference_team().robots[0].camera
        sent = [
            ros_bags.image("/A/image", 10**18, np.zeros((6, 8), np.uint8)),
            *(ros_bags.camera_info(f"/{one}/info", 10**18, camera) for one in "AB"),
            *(
                ros_bags.odometry(f"/{one}/odom", 10**18 + k * 10**8, (0.01 * k, 0.0, 0.0))
                for one in "AB"
                for k in range(3)
            ),
        ]
        bag = ros_bags.write_bag(FOLDER / "bags", kind, sent)
        yield (bag if bag.is_file() else next(bag.glob("*.db3"))).read_bytes()

    return made


def _of_cdr() -> Iterator[bytes]:
    for data in _of_bag("bare mcap")():
        path = _file(data, ".mcap")
        with open_bag(path) as bag:
            for one in bag.messages(set(bag.topics)):
                yield bytes([_TYPES.index(one.type)]) + one.data


def _of_tum() -> Iterator[bytes]:
    T = np.tile(np.eye(4), (3, 1, 1))
    write_tum(Trajectory("A", np.arange(3.0), T, np.arange(3), np.tile(np.eye(6), (3, 1, 1))), FOLDER / "seed.tum")
    yield (FOLDER / "seed.tum").read_bytes() + b"===\n" + (FOLDER / "seed.cov.csv").read_bytes()
    euroc = "1403636579758555392,0.1,0.2,0.3,1,0,0,0,0,0,0,0,0,0,0,0,0\n"
    yield (
        "#timestamp, p_x [m], p_y, p_z, q_w [], q_x [], q_y [], q_z [], v_x, v_y, v_z, b, b, b, b, b, b\n" + euroc
    ).encode()
    yield b"1.5 1 0 0 4 0 1 0 5 0 0 1 6\n2.5 1 0 0 4 0 1 0 5 0 0 1 7\n"


def _of_g2o() -> Iterator[bytes]:
    key = gtsam.symbol("a", 1)
    yield (
        f"# 0 is A@0 = A@1\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT {key} 1 0 0 0 0 0 1\nFIX 0\n"
        f"# STAY_PUT A 0 1\nEDGE_SE3:QUAT 0 {key} 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
    ).encode()
    yield b"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"


def _of_tracks() -> Iterator[bytes]:
    rows = [f"0,{t},{robot},C/{k},{100 + 9 * t * k},{90 + 7 * t}" for t in range(5) for robot in "AB" for k in (0, 1)]
    more = "===\nstance,robot,nx,ny,nz,d\n0,A,0,-1,0,0.25\n===\nstance,robot\n"
    yield ("stance,time,robot,marker,u,v\n" + "\n".join(rows) + "\n" + more).encode()


def _of_result() -> Iterator[bytes]:
    summary = {"version": "0", "method": "joint", "robots": ["A", "B"], "run": "x.mcap", "bumped": [["A", 0, 1]]}
    yield (
        msgspec.json.encode(summary)
        + b"===\n[options]\n[team]\n"
        + next(_of_team()).replace(b"[robots", b"[team.robots")
    )


def _of_images() -> Iterator[bytes]:
    for suffix in (".png", ".jpg", ".bmp", ".tiff", ".pgm", ".webp"):
        yield cv2.imencode(suffix, np.arange(48, dtype=np.uint8).reshape(6, 8))[1].tobytes()


def _of_link() -> Iterator[bytes]:
    sample = messages.Sample(session="s", number=0, capture=0, stamp=1, uv=[(1.0, 2.0)], covariance=[(1.0, 0.0, 1.0)],
                             markers=["C/0"], flags=[0], peak=[9.0], area=[3.0])  # fmt: skip
    wheels = messages.Wheels(session="s", number=0, stamp=1, pose=(0.0, 0.0, 0.0), covariance=(1.0, 0, 0, 1.0, 0, 1.0))
    drive = messages.Drive(number=0, places=[(1.0, 0.0)], yaw=None, speed=0.2)
    every = [
        sample,
        wheels,
        messages.Event(session="s", number=0, stamp=1, kind="arrived", text="x"),
        messages.Status(
            session="s",
            stamp=1,
            phase="idle",
            capture=None,
            moving=False,
            still_since=1,
            fault=None,
            camera_fault=None,
            hazards=[],
        ),
        messages.Command(id="1", session="s", deadline=5, body=drive),
        messages.Hold(session="s", sent=1),
        messages.Reply(id="1", ok=True),
        messages.ClockQuestion(asked=1),
        messages.ClockReply(session="s", asked=1, received=2, sent=3),
    ]
    for one in every:
        yield bytes([_KINDS.index(type(one))]) + messages.encode(one)


def _of_opencv() -> Iterator[bytes]:
    camera = reference_team().robots[0].camera
    for suffix in (".yml", ".xml"):
        path = FOLDER / f"seed{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, value in (("image_width", camera.width), ("image_height", camera.height), ("fisheye_model", 0)):
            storage.write(name, value)
        storage.write("camera_matrix", camera.K)
        storage.write("distortion_coefficients", np.array([0.1, 0.02, 0.0, 0.0, 0.0]))
        storage.release()
        yield path.read_bytes()


def _of_kalibr() -> Iterator[bytes]:
    yield (
        b"cam0:\n  camera_model: pinhole\n  distortion_coeffs: [-0.01, 0.02, -0.003, 0.0004]\n"
        b"  distortion_model: equidistant\n  intrinsics: [461.6, 460.1, 362.6, 248.1]\n  resolution: [752, 480]\n"
    )


def _of_camera_info() -> Iterator[bytes]:
    text = camera_info_text(reference_team().robots[0].camera, "A")
    yield text.encode()
    yield (
        f"{text}binning_x: 2\nbinning_y: 2\nroi: {{x_offset: 8, y_offset: 8, height: 64, width: 64}}\n---\n"
    ).encode()


def _of_pyfg() -> Iterator[bytes]:
    yield (
        b"VERTEX_SE2 1700000001.7 A0 1.25 3.0 -1.5\nVERTEX_SE2 1700000001.9 A1 1.5 3.25 -1.25\n"
        b"VERTEX_SE2 1700000001.7 B3 0.0 0.0 0.5\n"
        b"VERTEX_XY L8 2.0 1.0\nVERTEX_SE2:PRIOR 1700000001.7 A0 1.25 3.0 -1.5 0.01 0.0 0.0 0.01 0.0 0.001\n"
        b"EDGE_SE2 1700000001.9 A0 A1 0.25 0.125 0.25 0.0004 0.0001 -0.0 0.0005 -0.0 0.0001\n"
        b"EDGE_SE2_XY 1700000001.9 A1 L8 1.0 -2.0 0.25 0.125 0.5\nEDGE_RANGE 1700000001.7 A0 B3 3.5 0.0073\n"
    )
    yield (
        b"VERTEX_SE3:QUAT 1700000001.0 A0 0.0 0.0 0.0 0.0 0.0 0.0 1.0\n"
        b"VERTEX_SE3:QUAT 1700000002.0 A1 1.0 0.0 0.5 0.0 0.0 0.6 0.8\n"
        b"VERTEX_XYZ L0 1.0 2.0 3.0\nEDGE_SE3:QUAT 1700000002.0 A0 A1 1.0 0.0 0.5 0.0 0.0 0.6 0.8 "
        b"1 0 0 0 0 0.5 2 0 0 0 0 3 0 0 0 4 0 0 5 0 6\n"
        b"EDGE_SE3_XYZ 1700000002.0 A1 L0 0.5 1.5 2.5 0.25 0.0 0.0 0.25 0.0 0.25\n"
        b"EDGE_RANGE 1700000002.0 A0 L0 3.75 0.01\n"
    )


def _of_jrl() -> Iterator[bytes]:
    for text in _of_pyfg():
        graph = read_range_graph(_file(text, ".pyfg"))
        write_jrl(graph, FOLDER / "seed.jrl")
        yield (FOLDER / "seed.jrl").read_bytes()


def _of_config() -> Iterator[bytes]:
    write_config(SolveOptions(), reference_team(), FOLDER)
    yield (FOLDER / CONFIG).read_bytes()


_SEEDS: dict[str, Callable[[], Iterator[bytes]]] = {
    "team": _of_team,
    "ros_map": lambda: iter((MAP.encode(),)),
    "run": _of_run,
    "chunk": _of_chunk,
    "record": _of_record,
    "bag_mcap": _of_bag("bare mcap"),
    "bag_import": _of_bag("bare mcap"),
    "bag_db3": _of_bag("sqlite3"),
    "bag_ros1": _of_bag("ros1"),
    "cdr": _of_cdr,
    "camera_info": _of_camera_info,
    "opencv": _of_opencv,
    "kalibr": _of_kalibr,
    "pyfg": _of_pyfg,
    "jrl": _of_jrl,
    "ranges": lambda: iter((b"time,robot,target,range\n1.5,A,B,2.5\n1.5,A,C,3\n2,B,A,1e0\n",)),
    "config": _of_config,
    "tum": _of_tum,
    "g2o": _of_g2o,
    "tracks": _of_tracks,
    "table": lambda: iter((b"stance,time,robot,marker,u,v\n0,1,A,m,2,3\n", b"# x\n1.0 2 3 4\n")),
    "result": _of_result,
    "landmarks": lambda: iter((b"name,x,y\nL,1,2\n",)),
    "image": _of_images,
    "link": _of_link,
}
