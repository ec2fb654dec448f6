"""Seeds of fuzzing: real inputs of each target, small."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import gtsam
import msgspec
import numpy as np

from coloc_graph.exchange.camera_info import camera_info_text
from coloc_graph.exchange.jrl import write_jrl
from coloc_graph.exchange.range_graph_files import read_range_graph
from coloc_graph.exchange.ros_bag import open_bag
from coloc_graph.exchange.tum import write_tum
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.results.config import CONFIG, write_config
from coloc_graph.robot_io.link import messages
from coloc_graph.simulation import reference_team, simulate
from coloc_graph.team import write_team
from fuzz.targets import FOLDER, KINDS, MAP, TYPES, written


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
        path = written(data, ".mcap")
        with open_bag(path) as bag:
            for one in bag.messages(set(bag.topics)):
                yield bytes([TYPES.index(one.type)]) + one.data


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
        yield bytes([KINDS.index(type(one))]) + messages.encode(one)


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
        graph = read_range_graph(written(text, ".pyfg"))
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
