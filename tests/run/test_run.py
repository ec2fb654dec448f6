"""Writing a run and reading it back: round trips, refusals, laziness, truth, and the conformance files."""

import dataclasses
import math
import resource
import time
import tracemalloc
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conformance_run import CONFORMANCE, check_everything, everything, make, same
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from coloc_graph.errors import RunError
from coloc_graph.geometry.lie import floor_pose, rotation_x, rotation_y, rotation_z, se3
from coloc_graph.pipeline.contents import repeated_in
from coloc_graph.run import (
    Detections,
    Flag,
    Image,
    Motion,
    OdometrySample,
    Planes,
    RunWriter,
    Stance,
    atomic_run,
    chunks,
    open_run,
    read_true_team,
    read_truth,
    schemas,
)

T0 = make.T0


@pytest.mark.parametrize("flush_every", [None, 0.5])
def test_everything_that_is_written_is_read_back(tmp_path, flush_every):
    run = open_run(everything(tmp_path / "run.mcap", flush_every=flush_every))
    check_everything(run)
    assert run.warnings == ()


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize(("image_format", "error"), [("raw", 0), ("png", 0), ("jpeg", 4)])
def test_images_keep_shape_and_grey_levels(tmp_path, image_format, channels, error):
    rows, columns = np.mgrid[:48, :37]
    pixels = (2 * rows + 3 * columns).astype(np.uint8)
    if channels:
        pixels = np.stack([pixels, pixels // 2, 200 - pixels // 2], axis=-1)
    with atomic_run(tmp_path / "run.mcap", make.team(), image_format=image_format) as writer:
        writer.write(Image("A", 1.5, pixels))
        writer.write(Image("A", 2.5, pixels[:, ::-1]))  # not contiguous
    run = open_run(tmp_path / "run.mcap")
    first, second = run.images("A")
    assert (first.robot, first.time, first.pixels.dtype, first.pixels.shape) == (
        "A",
        1.5,
        np.uint8,
        pixels.shape,
    )
    for found, wanted in ((first.pixels, pixels), (second.pixels, pixels[:, ::-1])):
        assert abs(found.astype(int) - wanted).mean() <= error
    assert run.has_images("A")
    assert not run.has_images("B")
    assert not run.has_detections("A")


def test_an_image_without_markers_is_not_the_same_as_no_image(tmp_path):
    nothing = Detections(
        "A", 3.0, np.empty((0, 2)), np.empty((0, 2, 2)), (), np.empty(0, np.uint8), np.empty(0), np.empty(0)
    )
    with atomic_run(tmp_path / "run.mcap", make.team()) as writer:
        writer.write(nothing)
    (found,) = open_run(tmp_path / "run.mcap").detections("A")
    assert same(found, nothing)


def test_of_images_with_the_same_stamp_the_first_counts(tmp_path):
    """As in bags whose publisher was started twice; a time of its own each needs whoever interpolates."""
    with atomic_run(tmp_path / "run.mcap", make.team()) as writer:
        for n, time in enumerate([1.0, 2.0, 2.0, 2.0, 3.0]):
            pixels = np.full((40, 60), n, np.uint8)
            writer.write(Image("A", time, pixels))
            one = np.array([[n, 0.0]]), np.eye(2)[None], ("",), np.zeros(1, np.uint8), np.ones(1), np.ones(1)
            writer.write(Detections("B", time, *one))
    run = open_run(tmp_path / "run.mcap")
    assert run.repeated == {}
    for _ in range(2):  # what is read twice is counted once
        assert [one.uv[0, 0] for one in run.detections("B")] == [0, 1, 4]
        assert [round(one.pixels.mean()) for one in run.images("A", 1.5, 2.5)] == [1]
    assert run.repeated == {"/B/detections": 2, "/A/image": 2}
    assert next(str(one) for one in repeated_in(run)).startswith("2 detection records not used: of messages of B")


def test_every_flag_survives(tmp_path):
    flags = np.arange(16, dtype=np.uint8)
    n = len(flags)
    record = Detections(
        "A", 0.0, np.ones((n, 2)), np.tile(np.eye(2), (n, 1, 1)), ("",) * n, flags, np.ones(n), np.ones(n)
    )
    with atomic_run(tmp_path / "run.mcap", make.team()) as writer:
        writer.write(record)
    (found,) = open_run(tmp_path / "run.mcap").detections("A")
    assert found.flags.tolist() == flags.tolist()
    assert Flag(int(found.flags[5])) == Flag.SATURATED | Flag.MERGED


@pytest.mark.parametrize("seconds", [0.0, 0.1, 12.3, 1_700_000_000.123456, 1_763_784_169.7654321, 4e9 / 3])
def test_times_come_back_to_the_last_bit(seconds):
    assert schemas.to_seconds(schemas.to_ns(seconds)) == seconds
    assert abs(schemas.to_ns(seconds) - seconds * 10**9) < 300


@pytest.mark.parametrize("seconds", [-1e-9, 2.0**63 / 1e9, 1e18, math.inf, math.nan])
def test_times_that_a_file_cannot_hold_are_refused(seconds):
    with pytest.raises(RunError, match="cannot be recorded; give UTC seconds"):
        schemas.to_ns(seconds)


def test_truth_is_kept_from_a_run_and_given_to_evaluation(tmp_path):
    path = tmp_path / "run.mcap"
    poses = [
        floor_pose(1.0, 2.0, 0.3),
        floor_pose(0.0, 0.0, math.pi),
        se3(rotation_z(3) @ rotation_y(1) @ rotation_x(-2), [1.0, 2.0, 3.0]),
    ]
    with atomic_run(path, make.team()) as writer:
        for k, T_world_body in enumerate(poses):
            writer.write_truth("B", 5.0 + k, T_world_body)
        writer.write(Motion("A", 6.0, True))
        writer.write_true_team(make.team(21.0))
    run = open_run(path)
    assert run.topics == {"/team": 1, "/A/motion": 1}
    assert (run.start, run.end) == (6.0, 6.0)
    assert "truth" not in repr(vars(run)).replace(str(path), "")
    truth = read_truth(path)
    assert list(truth) == ["B"]
    assert truth["B"].times.tolist() == [5.0, 6.0, 7.0]
    np.testing.assert_allclose(truth["B"].T_world_body, poses, atol=1e-12)
    assert read_true_team(path) == make.team(21.0)
    assert read_true_team(CONFORMANCE / "minimal.mcap") is None
    assert read_truth(CONFORMANCE / "minimal.mcap") == {}


def test_a_time_range_includes_both_ends(tmp_path):
    with atomic_run(tmp_path / "run.mcap", make.team()) as writer:
        for k in range(1000):
            writer.write(Motion("A", T0 + k / 100, bool(k % 2)))
    run = open_run(tmp_path / "run.mcap")
    times = [motion.time for motion in run.motions("A", T0 + 2, T0 + 3)]
    assert times == [T0 + k / 100 for k in range(200, 301)]
    assert len(list(run.motions("A", start=T0 + 9.9))) == 10
    assert list(run.motions("A", end=T0 - 1)) == []
    assert len(list(run.motions("A", -math.inf, math.inf))) == 1000


def test_reading_touches_only_the_chunks_asked_for(tmp_path, monkeypatch):
    noise = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    with atomic_run(tmp_path / "run.mcap", make.team(), image_format="raw") as writer:
        for k in range(200):
            writer.write(Image("A" if k < 100 else "B", T0 + k / 100, noise))
    size = (tmp_path / "run.mcap").stat().st_size
    assert size > 1.5e7
    decoded = []
    real = chunks.decompressed
    monkeypatch.setattr(chunks, "decompressed", lambda *a: decoded.append(a[2].offset) or real(*a))
    tracemalloc.start()
    run = open_run(tmp_path / "run.mcap")
    assert len(run._index.chunks) > 90
    assert len(decoded) < 12  # where topics first appear, and the ends of each
    decoded.clear()
    assert len(list(run.images("A", T0 + 0.5, T0 + 0.55))) == 6
    assert len(decoded) <= 6
    decoded.clear()
    assert sum(1 for _ in run.images("B")) == 100
    assert len(decoded) <= 52  # half of the file
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.7 * size  # what is kept are the chunks that were read


def test_the_same_input_gives_the_same_bytes(tmp_path):
    first, second = (everything(tmp_path / name) for name in ("a.mcap", "b.mcap"))
    assert first.read_bytes() == second.read_bytes()


def test_other_readers_of_mcap_find_everything(tmp_path):
    with everything(tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "coloc-graph-run-1"
        found = [(channel.topic, schema, message) for schema, channel, message in reader.iter_messages()]
    assert found[0][0] == "/team"
    assert len(found) == 25
    for topic, schema, message in found:
        assert message.log_time == message.publish_time > 0
        assert schema.encoding == ("protobuf" if topic.endswith(("image", "truth")) else "jsonschema")


def refusals():
    good = make.detections("A", 1.0)
    nan = float("nan")
    T = np.eye(4)
    yield "robot `Z`", lambda w: w.write(Motion("Z", 1.0, True))
    yield "robot `Z`", lambda w: w.write(Stance(0, 1.0, 2.0, ("A", "Z")))
    yield "robot `Z`", lambda w: w.write(Planes(0, 1.0, {"Z": (0.0, 0.0, 1.0, 1.0)}))
    yield "robot `Z`", lambda w: w.write_truth("Z", 1.0, T)
    yield "NaN", lambda w: w.write(dataclasses.replace(good, uv=good.uv * [[nan, 1], [1, 1]]))
    yield "NaN", lambda w: w.write(dataclasses.replace(good, covariance=good.covariance + math.inf))
    yield "shape", lambda w: w.write(dataclasses.replace(good, peak=good.peak[:1]))
    yield "`markers`", lambda w: w.write(dataclasses.replace(good, markers=("",)))
    yield (
        "symmetric",
        lambda w: w.write(dataclasses.replace(good, covariance=np.arange(8.0).reshape(2, 2, 2))),
    )
    yield "NaN", lambda w: w.write(OdometrySample("A", 1.0, np.array([0, nan, 0]), np.eye(3)))
    yield "time nan", lambda w: w.write(Motion("A", nan, True))
    yield "time -1", lambda w: w.write(Motion("A", -1.0, True))
    yield "time inf", lambda w: w.write(Stance(0, 1.0, math.inf, ("A", "B")))
    yield "before it starts", lambda w: w.write(Stance(0, 2.0, 1.0, ("A", "B")))
    yield "observer and a mover", lambda w: w.write(Stance(0, 1.0, 2.0, ("A", "B"), ("B",)))
    yield "d > 0", lambda w: w.write(Planes(0, 1.0, {"A": (0.0, 0.0, 1.0, -1.0)}))
    yield "rigid", lambda w: w.write_truth("A", 1.0, T * nan)
    yield "rigid", lambda w: w.write_truth("A", 1.0, T * 2)
    yield "rigid", lambda w: w.write_truth("A", 1.0, np.diag([1.0, 1.0, -1.0, 1.0]))
    yield "uint8", lambda w: w.write(Image("A", 1.0, np.zeros((4, 4))))
    yield "shape", lambda w: w.write(Image("A", 1.0, np.zeros((4, 4, 4), np.uint8)))
    yield "backwards in /A/motion", lambda w: [w.write(Motion("A", time, True)) for time in (2.0, 1.0)]
    yield "written twice", lambda w: [w.write_true_team(make.team()) for _ in range(2)]
    yield "closed", lambda w: [w.close(), w.write(Motion("A", 1.0, True))]


@pytest.mark.parametrize(("words", "act"), list(refusals()))
def test_the_writer_refuses_in_a_sentence_and_the_file_stays_good(tmp_path, words, act):
    with RunWriter(tmp_path / "run.mcap", make.team(), flush_every=None) as writer:
        writer.write(Motion("B", 1.0, True))
        with pytest.raises(RunError, match=words) as refusal:
            act(writer)
    assert "\n" not in str(refusal.value)
    assert list(open_run(tmp_path / "run.mcap").motions("B")) == [Motion("B", 1.0, True)]


def test_topics_need_not_be_in_step_with_each_other(tmp_path):
    with atomic_run(tmp_path / "run.mcap", make.team()) as writer:
        writer.write(Motion("A", 10.0, True))
        writer.write(Stance(0, 5.0, 9.0, ("A", "B")))  # written when it is over
        writer.write(Motion("B", 3.0, True))
    run = open_run(tmp_path / "run.mcap")
    assert (run.start, run.end, run.stances[0].start) == (3.0, 10.0, 5.0)


def test_an_exception_finishes_a_recording_and_removes_a_whole_run(tmp_path):
    for context, name in ((RunWriter, "recording.mcap"), (atomic_run, "whole.mcap")):
        with pytest.raises(ZeroDivisionError), context(tmp_path / name, make.team()) as writer:
            writer.write(Motion("A", 1.0, True))
            assert not (tmp_path / "whole.mcap").exists()
            raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["recording.mcap"]
    run = open_run(tmp_path / "recording.mcap")
    assert run.warnings == ()
    assert len(list(run.motions("A"))) == 1


def test_a_whole_run_that_fails_leaves_what_was_there(tmp_path):
    path = everything(tmp_path / "run.mcap")
    before = path.read_bytes()
    with pytest.raises(RunError), atomic_run(path, make.team()) as writer:
        writer.write(Motion("Z", 1.0, True))
    assert path.read_bytes() == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has it")
def test_a_full_disk_is_a_sentence(tmp_path):
    with pytest.raises(RunError, match="No space left"), RunWriter("/dev/full", make.team()):
        pass
    with pytest.raises(RunError, match="No such file"):
        RunWriter(tmp_path / "nowhere" / "run.mcap", make.team())


def test_a_disk_that_fills_up_stops_the_recording_and_keeps_what_it_holds(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = RunWriter(tmp_path / "run.mcap", make.team(), image_format="raw", flush_every=0.02)
    noise = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    try:
        with pytest.raises(RunError, match="File too large"):
            for k in range(1000):
                writer.write(Image("A", float(k), noise))
                time.sleep(0.01)
        with pytest.raises(RunError, match="File too large"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    writer.close()
    run = open_run(tmp_path / "run.mcap")
    assert len(list(run.images("A"))) >= 1
    assert "was cut off" in run.warnings[0]


def test_a_run_of_a_team_alone_opens(tmp_path):
    with atomic_run(tmp_path / "run.mcap", make.team()):
        pass
    run = open_run(tmp_path / "run.mcap")
    assert (run.team, run.stances, run.start, run.end) == (make.team(), (), None, None)
    assert list(run.images("A")) == []
    with pytest.raises(RunError, match="robot `Z`"):
        run.images("Z")


def foreign(path, rows, profile="", **options):
    """A file as another writer might make it: rows of (topic, schema, encoding, ns, data)."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile=profile)
        ids = {}
        for topic, schema, encoding, ns, data in rows:
            if topic not in ids:
                ids[topic] = writer.register_channel(topic, encoding, writer.register_schema(schema, "", b""))
            writer.add_message(ids[topic], ns, data, ns)
        writer.finish()
    return path


TEAM_ROW = ("/team", "coloc_graph.Team", "json", 5, msgspec.json.encode(make.team()))


def stance_row(ns=5, **changes):
    wire = {"index": 0, "end_ns": 10**9, "observers": ["A", "B"], "movers": [], "anchors": []} | changes
    wire = {name: value for name, value in wire.items() if value is not None}
    return ("/stance", "coloc_graph.Stance", "json", ns, msgspec.json.encode(wire))


MOTION = ("coloc_graph.Motion", "json")
PLANES_ROW = ("/planes", "coloc_graph.Planes", "json", 5, b'{"stance": 0, "planes": {}}')


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([stance_row()], "without a /team"),
        ([TEAM_ROW, TEAM_ROW], "2 messages of /team"),
        ([TEAM_ROW, stance_row(observers=["A", "Z"])], "stance 0 names robot `Z`"),
        ([TEAM_ROW, stance_row(), stance_row(ns=6)], "stance 0 is recorded twice"),
        ([TEAM_ROW, PLANES_ROW, PLANES_ROW], "planes of stance 0 are recorded twice"),
        ([TEAM_ROW, stance_row(), stance_row(ns=4, index=1)], "backwards in /stance at 4e-09 s"),
        ([TEAM_ROW, stance_row(end_ns=None)], r"/stance at 5e-09 s is wrong: .*`end_ns`"),
        ([TEAM_ROW, stance_row(colour=1)], r"unknown field `colour`"),
        ([TEAM_ROW, stance_row(observers=["A", 7])], r"\$.observers\[1\]"),
        ([TEAM_ROW, stance_row(end_ns=1)], "before it starts"),
        ([TEAM_ROW, stance_row(end_ns=-(10**30))], "/stance"),
        ([TEAM_ROW, ("/Z/motion", *MOTION, 5, b"{}")], "/Z/motion names robot `Z`"),
        ([TEAM_ROW, ("/A/motion", "Other", "json", 5, b"{}")], "`Other`"),
        ([TEAM_ROW, ("/A/image", "foxglove.RawImage", "ros1", 5, b"")], "`ros1`"),
        ([("/team", "coloc_graph.Team", "json", 5, b'{"reference": "A"}')], "/team .*`robots`"),
    ],
)
def test_contradictions_are_found_when_a_run_is_opened(tmp_path, rows, words):
    with pytest.raises(RunError, match=words) as refusal:
        open_run(foreign(tmp_path / "run.mcap", rows))
    assert "run.mcap" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b'{"u": [1], "v": []}', "covariance"),
        (
            b'{"u":[1],"v":[],"covariance":[[1,0,1]],"marker":[""],"flags":[[]],"peak":[1],"area":[1]}',
            "`v` has 0 entries for 1",
        ),
        (
            b'{"u":[1],"v":[1],"covariance":[[1,0,1]],"marker":[""],"flags":[["odd"]],"peak":[1],"area":[1]}',
            r"'odd'.*\$.flags",
        ),
        (b"\xff\xfe", "detections at 5e-09 s"),
        (b'{"u": [1e999]}', "detections at 5e-09 s"),
    ],
)
def test_a_wrong_message_is_named_with_topic_and_time(tmp_path, data, words):
    row = ("/A/detections", "coloc_graph.Detections", "json", 5, data)
    run = open_run(foreign(tmp_path / "run.mcap", [TEAM_ROW, row]))
    with pytest.raises(RunError, match=words):
        list(run.detections("A"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"encoding": "rgb8"}, "rgb8"),
        ({"data": b"123"}, "3 bytes"),
        ({"step": 0}, "bytes of `data`"),
        ({"width": 0xFFFFFFFF}, "bytes of `data`"),
    ],
)
def test_a_wrong_image_is_named(tmp_path, changes, words):
    fields = {"width": 2, "height": 2, "encoding": "mono8", "step": 2, "data": b"1234"} | changes
    image = schemas.protobuf_type(schemas.RAW_IMAGE)(**fields)
    image.timestamp.nanos = 5
    row = ("/A/image", schemas.RAW_IMAGE, "protobuf", 5, image.SerializeToString())
    run = open_run(foreign(tmp_path / "run.mcap", [TEAM_ROW, row]))
    with pytest.raises(RunError, match=words):
        list(run.images("A"))


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE, "enable_crcs": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False}
        | {"repeat_channels": False, "repeat_schemas": False},
    ],
)
def test_other_writers_choices_are_read(tmp_path, options):
    motions = [("/A/motion", *MOTION, 5 + k, b'{"moving": true}') for k in range(100)]
    path = foreign(tmp_path / "run.mcap", [TEAM_ROW, stance_row(), *motions], chunk_size=2000, **options)
    run = open_run(path)
    assert run.topics == {"/team": 1, "/stance": 1, "/A/motion": 100}
    assert [motion.time for motion in run.motions("A")] == [(5 + k) / 10**9 for k in range(100)]
    assert run.warnings == ()


def test_messages_outside_of_chunks_are_refused(tmp_path):
    with pytest.raises(RunError, match="outside of chunks"):
        open_run(foreign(tmp_path / "run.mcap", [TEAM_ROW], use_chunking=False))


def test_a_later_format_is_refused_and_a_strange_topic_is_a_warning(tmp_path):
    with pytest.raises(RunError, match="format 2"):
        open_run(foreign(tmp_path / "later.mcap", [TEAM_ROW], profile="coloc-graph-run-2"))
    run = open_run(foreign(tmp_path / "more.mcap", [TEAM_ROW, ("/A/imu", "Imu", "json", 7, b"?")]))
    assert len(run.warnings) == 1
    assert "/A/imu" in run.warnings[0]


def test_conformance_minimal():
    run = open_run(CONFORMANCE / "minimal.mcap")
    assert run.stances == (Stance(0, T0, T0 + 1, ("A", "B"), ("C",)),)
    assert (run.team, run.topics) == (make.team(), {"/team": 1, "/stance": 1})


def test_conformance_everything():
    path = CONFORMANCE / "everything.mcap"
    check_everything(open_run(path))
    assert open_run(path).warnings == ()
    assert read_true_team(path) == make.team(20.5)
    np.testing.assert_allclose(read_truth(path)["C"].positions, [[1, 2, 0], [1.1, 2, 0], [1.2, 2, 0]])
    np.testing.assert_allclose(read_truth(path)["C"].T_world_body[0, :3, 0], [0, 1, 0], atol=1e-12)


def test_conformance_cut_off():
    run = open_run(CONFORMANCE / "cut-off.mcap")
    check_everything(run)
    assert "the last 5 bytes could not be read" in run.warnings[0]
    assert "1700000001.250 s" in run.warnings[0]


def test_conformance_damaged():
    with pytest.raises(RunError, match=r"damaged at byte 1654 \(a chunk that"):
        open_run(CONFORMANCE / "damaged.mcap")


def test_truth_near_an_estimate_is_the_truth_that_is_compared(short):
    from coloc_graph.evaluation import align
    from coloc_graph.geometry.trajectory import Trajectory
    from coloc_graph.run import truth_counts

    whole = read_truth(short)
    assert truth_counts(short) == {robot: len(true) for robot, true in whole.items()}
    true = whole["C"]
    times = np.concatenate([true.times[[0, 40, -1]], [true.times[3] + 0.003, true.times[-2] + 0.001]])
    estimated = {"C": Trajectory("C", np.sort(times), np.tile(np.eye(4), (5, 1, 1)))}
    near = read_truth(short, estimated)
    assert len(near["C"]) <= 12 < len(true) and set(near) == set(whole)
    for name in ("times", "T_world_body"):
        assert np.isin(getattr(near["C"], name), getattr(true, name)).all()
    expected, found = (align(estimated, one, "C", on_floor=True)["C"] for one in (whole, near))
    np.testing.assert_array_equal(expected, found)
