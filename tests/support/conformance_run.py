"""The run of the conformance files, which holds a record of every kind: writing it, and checking what is read."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np

from coloc_graph.run import Motion, OdometrySample, Planes, Stance, atomic_run

CONFORMANCE = Path(__file__).parents[1] / "run" / "conformance" / "run"
_spec = importlib.util.spec_from_file_location("conformance_make", CONFORMANCE / "make.py")
make = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(make)
T0 = make.T0


def same(a, b):
    """Whether two records are equal, arrays and all."""
    return type(a) is type(b) and all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
    )


def everything(path, **options):
    with atomic_run(path, make.team(), **({"image_format": "png"} | options)) as writer:
        make.write_everything(writer)
    return path


def check_everything(run):
    assert run.team == make.team()
    assert [stance.index for stance in run.stances] == [0, 1]
    assert run.stances[0] == Stance(0, T0, T0 + 1, ("A", "B"), ("C",))
    assert run.stances[1] == Stance(1, T0 + 1, T0 + 2, ("B", "C"), ("A",), ("B",))
    assert run.planes == {0: Planes(0, T0, {"A": (0.0, 0.6, 0.8, 0.25), "B": (0.0, 0.6, 0.8, 0.5)})}
    for robot in "AB":
        images = list(run.images(robot))
        assert [image.time for image in images] == [T0, T0 + 0.1, T0 + 0.2]
        assert all(np.array_equal(image.pixels, make.pixels(k)) for k, image in enumerate(images))
        assert all(same(found, make.detections(robot, T0 + k / 10)) for k, found in enumerate(run.detections(robot)))
    odometry = list(run.odometry("C"))
    assert same(odometry[2], OdometrySample("C", T0 + 0.2, np.array([0.2, -0.2, 0.3]), np.diag([1e-4, 2e-4, 3e-4])))
    assert list(run.motions("C")) == [Motion("C", T0, True), Motion("C", T0 + 0.5, False)]
    assert run.topics == {
        "/team": 1,
        "/stance": 2,
        "/planes": 1,
        **{f"/{robot}/{kind}": 3 for robot in "AB" for kind in ("image", "detections")},
        "/C/odometry": 3,
        "/C/motion": 2,
    }
    assert (run.start, run.end) == (T0, T0 + 1)
