"""Make the project's own data set, coloc_graph/simulation/leapfrog.mcap: a leap-frog with truth, as cameras see it.

    python scripts/example_run.py OUT.mcap

The hallway is rendered, marker centres are detected in each image, and the run keeps these, odometry, the
truth, and a few images to look at. The file in the package was made once by this script and does not change between
versions, so that figures on it can be compared.
"""

import sys
import tempfile
from pathlib import Path

from coloc_graph.frontend import detector_for
from coloc_graph.run import Detections, RunWriter, open_run, read_true_team, read_truth
from coloc_graph.simulation import Imperfections, simulate

STANCES = 12
SEED = 2026
IMPERFECTIONS = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
IMAGE_EVERY = 125  # images of which one is kept: one a stance


def detections(run, robot):
    """Yield the markers in each image of a robot, and now and then the image itself."""
    detect = detector_for(run.team["C"].markers, run.team[robot].camera)
    for index, image in enumerate(run.images(robot)):
        blobs = detect(image.pixels)
        names = ("",) * len(blobs.uv)
        yield Detections(robot, image.time, blobs.uv, blobs.covariance, names, blobs.flags, blobs.peak, blobs.area)
        if index % IMAGE_EVERY == 0:
            yield image


def main(out):
    """Render, detect, and write the run."""
    with tempfile.TemporaryDirectory() as folder:
        rendered = Path(folder) / "rendered.mcap"
        simulate("hallway", rendered, depth="images", stances=STANCES, seed=SEED, imperfections=IMPERFECTIONS)
        run = open_run(rendered)
        records = list(run.stances)
        for robot in run.team.names:
            records += [*run.odometry(robot), *run.motions(robot)]
        for robot in ("A", "B"):
            records += detections(run, robot)
        records.sort(key=lambda one: getattr(one, "start", None) or one.time)
        truth = read_truth(rendered)
        with RunWriter(out, run.team, image_format="jpeg") as writer:
            writer.write_true_team(read_true_team(rendered))
            for robot, true in truth.items():
                for time, T in zip(true.times.tolist(), true.T_world_body, strict=True):
                    writer.write_truth(robot, time, T)
            for record in records:
                writer.write(record)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
