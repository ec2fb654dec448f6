"""Factors and values of an estimate as GTSAM itself serialises them, with a script that needs nothing but GTSAM.

Of `chain` and `smooth` the factors are those that were solved. Of `joint` the homographies and sighted markers, which
GTSAM has no factors for, are linearised at the optimum: `LinearContainerFactor` on poses, mounts, markers and clocks.
So is the prior of a body's tilt, which GTSAM does not serialise; its residual is in the body frame and hardly bends.
`AttitudeFactorPose3` would make the sigmas of uncertain headings too small (`Factors.of_pose`).
"""

import csv
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path

import gtsam

from coloc_graph.backend import Estimate
from coloc_graph.backend.calibration import CLOCKS, MARKERS, MOUNT, PLANE, RANGING
from coloc_graph.backend.factors import GAUGE_SIGMA, Factors, calibrations_in, poses_in
from coloc_graph.backend.landmarks import MAP
from coloc_graph.errors import InputError
from coloc_graph.exchange.relative_edges import used_links

SCRIPT = Path(__file__).with_name("gtsam_script.txt")  # text, since it runs where coloc-graph is not
EPOCH = (1980, 1, 1, 0, 0, 0)  # time of all members of the archive, so that its bytes are reproducible
CALIBRATIONS = {
    MOUNT: "mount errors: height [m], tilt, roll [rad]",
    MARKERS: "marker errors: span (relative), height [m]",
    CLOCKS: "clock offset error [s]",
    RANGING: "range sensor errors: offset [m], scale, bearing [rad], x, y [m], depth, offset of robots [m]",
    PLANE: "stated plane errors: normal [rad, rad], distance (relative)",
}


def gtsam_files(estimate: Estimate) -> dict[str, str]:
    """Return the files of an estimate for GTSAM, by name.

    Parameters
    ----------
    estimate : Estimate
        Of a run with stances.

    Returns
    -------
    dict of str to str
        graph.txt and values.txt as GTSAM serialises them, keys.csv, which names the keys, and solve.py, which loads and
        solves them.
    """
    return {
        "graph.txt": portable_factors(estimate).serialize(),
        "values.txt": estimate.values.serialize(),
        "keys.csv": _keys(estimate),
        "solve.py": SCRIPT.read_text(encoding="utf-8"),
    }


def portable_factors(estimate: Estimate) -> gtsam.NonlinearFactorGraph:
    """Return the factors of an estimate, those that GTSAM does not serialise linearised at its values."""
    values = estimate.values
    if estimate.method == "chain":
        graph, key = estimate.graph, estimate.graph.pose_keys.key
        factors = gtsam.NonlinearFactorGraph()
        gauge = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)
        factors.add(gtsam.PriorFactorPose3(graph.reference_key, gtsam.Pose3(), gauge))
        for link in used_links(estimate):
            factors.add(Factors(None).of_link(link, *map(key, link.ends)))
        return factors
    used = estimate.graph.without(one.measurement for one in estimate.rejected)
    factors_of = Factors(used.floor, estimate.calibration.variables)
    made, _, batched = factors_of.of_graph(used, poses_in(values))
    factors = gtsam.NonlinearFactorGraph()
    with batched:
        for n in range(made.size()):
            factor = made.at(n)
            if isinstance(factor, gtsam.CustomFactor | gtsam.MagPoseFactorPose3):
                factor = gtsam.LinearContainerFactor(factor.linearize(values), values)
            factors.add(factor)
    return factors


def _keys(estimate: Estimate) -> str:
    """Return keys.csv: every key, and what it is the pose or the calibration of."""
    graph = estimate.graph
    names: dict[int, list[str]] = {}
    for robot, stance in graph.nodes:
        names.setdefault(graph.key(robot, stance), []).append(f"{robot}@{stance}")
    for name, key in graph.pose_keys.static().items():
        names[key] = ["map" if name == MAP else f"landmark {name}"]
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(["key", "kind", "of"])
    for key in poses_in(estimate.values):
        rows.writerow([key, "pose", " ".join(names[key])])
    for key in calibrations_in(estimate.values):
        kind, variables = gtsam.mrsymbolChr(key), estimate.calibration.variables
        of = variables.owner(key) if variables is not None and kind in (MOUNT, MARKERS, RANGING) else ""
        if kind in (CLOCKS, PLANE):
            first, second = graph.robots[gtsam.mrsymbolLabel(key) - 1], gtsam.mrsymbolIndex(key)
            of = f"{first} {graph.robots[second - 1]}" if kind == CLOCKS else f"{first}@{second}"
        rows.writerow([key, CALIBRATIONS[kind], of])
    return out.getvalue()


def write_gtsam(files: Mapping[str, str], path: Path) -> None:
    """Write the files of an estimate for GTSAM, by name, as a zip archive, the same bytes for the same estimate."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            member = zipfile.ZipInfo(name, EPOCH)
            member.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(member, text)


def unpack_gtsam(path: Path, out: Path) -> None:
    """Write the members of the archive of `write_gtsam` to a folder.

    Raises
    ------
    InputError
        The archive is damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            texts = {name: archive.read(name) for name in ("graph.txt", "values.txt", "keys.csv", "solve.py")}
    except (zipfile.BadZipFile, KeyError, OSError) as error:
        raise InputError(f"{path} is damaged ({error}); solve the run again") from error
    out.mkdir(parents=True)
    for name, text in texts.items():
        (out / name).write_bytes(text)
