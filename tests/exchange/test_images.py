"""A team's own images: files read one way, their times, and the stances that the cameras' still backgrounds tell."""

import struct

import cv2
import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.exchange.image_sources import START, open_sources
from coloc_graph.exchange.images import import_images
from coloc_graph.image_file import decode_image, image_paths, range_of, read_image, to_8_bits
from coloc_graph.run import EncodedImage, Image, open_run
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team import write_team

TEAM = reference_team()
SIZE = (240, 320)


@pytest.fixture
def team(tmp_path):
    path = tmp_path / "team.toml"
    write_team(TEAM, path)
    return path


def background(seed, at=0):
    """What a camera sees of a room; at another place another part of it."""
    room = np.random.default_rng(seed).uniform(20, 90, (24, 80)).astype(np.float32)
    return cv2.resize(room, (1600, 240), interpolation=cv2.INTER_CUBIC)[:, at : at + 320]


def recorded(folder, seed, places, suffix=".png"):
    """Images of a camera at some places, with noise and a light that wanders."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    for number, at in enumerate(places, 1):
        image = background(seed, at) + rng.normal(0, 2, SIZE)
        image[100 + number % 50 : 104 + number % 50, 60 + number : 64 + number] = 255
        cv2.imwrite(str(folder / f"frame{number}{suffix}"), np.clip(image, 0, 255).astype(np.uint8))


def oriented(jpeg, orientation):
    """A JPEG with EXIF that says how to turn it."""
    exif = b"Exif\0\0MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


def test_numbers_in_names_sort_as_numbers_whatever_reads_them(tmp_path):
    for number in (1, 2, 10, 11):
        (tmp_path / f"frame{number}.png").write_bytes(b"")
    assert [path.stem for path in image_paths([tmp_path])] == ["frame1", "frame2", "frame10", "frame11"]


def test_exif_orientation_alpha_and_16_bits_become_upright_pixels_of_8_bits(tmp_path):
    grey = np.tile(np.linspace(0, 240, 12).astype(np.uint8), (8, 1))
    jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    plain, turned = decode_image(jpeg, "plain"), decode_image(oriented(jpeg, 3), "turned")
    assert plain.unchanged
    assert not turned.unchanged
    np.testing.assert_array_equal(turned.pixels, plain.pixels[::-1, ::-1])
    assert decode_image(oriented(jpeg, 6), "turned").pixels.shape == (12, 8)
    with_alpha = np.dstack([grey, grey, grey, np.full_like(grey, 255)])
    decoded = decode_image(cv2.imencode(".png", with_alpha)[1].tobytes(), "alpha")
    assert not decoded.unchanged
    np.testing.assert_array_equal(to_8_bits(decoded), np.dstack([grey, grey, grey]))
    paths = [tmp_path / "0.png", tmp_path / "1.png"]
    for path, top in zip(paths, (900, 3500), strict=True):  # a sensor of 12 bits, and a dark image of it
        cv2.imwrite(str(path), np.full((4, 4), top, np.uint16))
    values = range_of(paths, read_image(paths[0]))
    assert values == 4096
    assert to_8_bits(read_image(paths[0]), values)[0, 0] == 900 // 16
    with pytest.raises(InputError, match="cannot be read as an image"):
        decode_image(b"\x89PNG\r\n\x1a\n", "it")


def test_stances_are_found_by_who_stands_and_images_stay_as_they_are(team, tmp_path):
    stands, moves = [0] * 120, [0] * 40 + list(range(0, 400, 10)) + [400] * 40
    recorded(tmp_path / "A", 1, stands)
    recorded(tmp_path / "B", 2, moves, ".jpg")
    out = tmp_path / "run.mcap"
    summary = import_images(team, [f"A={tmp_path / 'A'}", f"B={tmp_path / 'B'}"], out, fps=10)
    assert summary.images == {"A": 120, "B": 120}
    assert summary.stood["A"] == pytest.approx((11.9, 11.9))
    first, second = summary.stances
    assert (first.observers, first.movers, first.anchors) == (("A", "B"), ("C",), ())
    assert (second.observers, second.movers, second.anchors) == (("A", "B"), ("C",), ("A",))
    assert first.start == START
    assert START + 3.0 <= first.end <= START + 4.0
    assert START + 8.0 <= second.start <= START + 9.0
    run = open_run(out)
    images = list(run.images("B", first.start, first.end))
    expected = cv2.imread(str(tmp_path / "B" / "frame2.jpg"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(images[1].pixels, expected)
    assert images[1].time == pytest.approx(START + 0.1)
    (source,) = open_sources(run.team, [f"B={tmp_path / 'B'}"], fps=10)
    assert next(source.records()).data == (tmp_path / "B" / "frame1.jpg").read_bytes()


def test_images_of_folders_have_their_times_by_the_end_of_their_paths(tmp_path):
    for stance in range(2):
        recorded(tmp_path / f"{stance}" / "A", 1, [0, 0])
    csv = tmp_path / "times.csv"
    csv.write_text("﻿robot,file,time\r\n" + "".join(
        f"A,{stance}/A/frame{n}.png,{100 + 30 * stance + n}\r\n" for stance in range(2) for n in (1, 2)
    ), encoding="utf-8")  # fmt: skip
    (source,) = open_sources(TEAM, [f"A={tmp_path}/*/A/*.png"], times=csv)
    assert source.times.tolist() == [101, 102, 131, 132]
    csv.write_text("robot,file,time\nA,frame1.png,1\nA,0/A/frame2.png,2\nA,1/A/frame2.png,3\n")
    with pytest.raises(InputError, match=r"`frame1.png` is the end of both .*0/A/frame1.png and .*1/A/frame1.png"):
        open_sources(TEAM, [f"A={tmp_path}/*/A/*.png"], times=csv)
    csv.write_text("robot,file,time\nA,0/A/frame1.png,1\nA,0/A/frame1.png,2\n")
    with pytest.raises(InputError, match=r"`0/A/frame1.png` of A is there twice; state its time once"):
        open_sources(TEAM, [f"A={tmp_path}/*/A/*.png"], times=csv)
    csv.write_text("robot,file,time\nA,0/A/frame1.png,1\n")
    with pytest.raises(InputError, match=r"has no time of .*0/A/frame2.png of robot A"):
        open_sources(TEAM, [f"A={tmp_path}/*/A/*.png"], times=csv)


def test_times_are_in_names_or_in_a_video(tmp_path):
    folder = tmp_path / "A"
    folder.mkdir()
    for ms in (1500, 900):
        cv2.imwrite(str(folder / f"left_{ms}.png"), np.zeros(SIZE, np.uint8))
    (source,) = open_sources(TEAM, [f"A={folder}"], pattern="left_{ms}")
    assert source.times.tolist() == [0.9, 1.5]
    video = tmp_path / "b.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE[::-1])
    for grey in (50, 100, 150):
        writer.write(np.full((*SIZE, 3), grey, np.uint8))
    writer.release()
    (source,) = open_sources(TEAM, [f"B={video}"])
    np.testing.assert_allclose(source.times - START, [0, 0.04, 0.08], atol=1e-3)
    assert [round(float(pixels.mean()) / 50) for pixels in source.pixels()] == [1, 2, 3]


@pytest.mark.parametrize(
    ("sources", "options", "words"),
    [
        (["A"], {"fps": 10}, "`A` is not ROBOT=SOURCE"),
        (["A=A", "A=A"], {"fps": 10}, "robot A has two sources"),
        (["X=A"], {"fps": 10}, "robot `X` is not in the team"),
        (["A=A"], {}, "give --times, --fps or --time-pattern"),
        (["A=A"], {"fps": 0.0}, "--fps is 0"),
        (["A=A"], {"fps": 10, "pattern": "x"}, "give one of them"),
        (["A=A"], {"pattern": "frame"}, "write {s}"),
        (["A=A"], {"pattern": "img_{s}"}, "its name is not like `img_{s}`"),
        (["A=none"], {"fps": 10}, "there is no such folder or video"),
        (["A=text.txt"], {}, "neither an image nor a video"),
    ],
)
def test_sources_that_cannot_be_are_refused(tmp_path, monkeypatch, sources, options, words):
    monkeypatch.chdir(tmp_path)
    recorded(tmp_path / "A", 1, [0, 0])
    (tmp_path / "text.txt").write_text("no video")
    with pytest.raises(InputError, match=words):
        open_sources(TEAM, sources, **options)


def test_images_of_another_size_and_stances_that_are_none_are_refused(team, tmp_path):
    recorded(tmp_path / "A", 1, [0] * 30)
    recorded(tmp_path / "B", 2, [10 * k for k in range(30)])
    given, out = [f"A={tmp_path / 'A'}", f"B={tmp_path / 'B'}"], tmp_path / "run.mcap"
    csv = tmp_path / "stances.csv"
    first = f"0,{START},{START + 1},A B,C,\n"
    csv.write_text(f"stance,start,end,observers,movers,anchors\n{first}1,{START + 1},{START + 2},A B,C,\n")
    assert [one.movers for one in import_images(team, given, out, fps=10, stances=csv).stances] == [("C",)] * 2
    csv.write_text(f"stance,start,end,observers,movers,anchors\n0,{START},{START + 2},A X,C,\n")
    with pytest.raises(InputError, match="line 2: `observers`: robot `X` is not in the team"):
        import_images(team, given, out, fps=10, stances=csv)
    csv.write_text(f"stance,start,end,observers,movers,anchors\n0,{START + 50},{START + 60},A B,C,\n")
    with pytest.raises(InputError, match="observer A has no image from"):
        import_images(team, given, out, fps=10, stances=csv)
    for rows, words in (
        (f"0,{START},{START},A B,C,\n", "line 2: it ends before it starts"),
        (f"{first}1,{START + 0.5},{START + 2},A B,C,\n", "line 3: .* starts before the last one ends"),
        (f"{first}2,{START + 1},{START + 2},A B,C,\n", "line 3: stance 2 comes where 1 is due"),
        (f"0,{START},{START + 1},A B,B,\n", "line 2: `B` both observes and moves"),
    ):
        csv.write_text(f"stance,start,end,observers,movers,anchors\n{rows}")
        with pytest.raises(InputError, match=words):
            import_images(team, given, out, fps=10, stances=csv)
    cv2.imwrite(str(tmp_path / "A" / "frame7.png"), np.zeros((10, 10), np.uint8))
    csv.write_text(f"stance,start,end,observers,movers,anchors\n0,{START},{START + 2},A B,C,\n")
    with pytest.raises(InputError, match=r"frame7\.png has 10 x 10 pixels, and the camera of A is 320 x 240"):
        import_images(team, given, tmp_path / "other.mcap", fps=10, stances=csv)
    assert not (tmp_path / "other.mcap").exists()


def test_records_are_images_or_files_as_they_are(tmp_path):
    recorded(tmp_path / "A", 1, [0])
    cv2.imwrite(str(tmp_path / "A" / "frame2.bmp"), np.zeros(SIZE, np.uint8))
    (source,) = open_sources(TEAM, [f"A={tmp_path / 'A'}"], fps=10)
    assert [type(one) for one in source.records()] == [EncodedImage, Image]
