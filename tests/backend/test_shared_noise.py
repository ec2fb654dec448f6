"""Errors that all samples of a marker share are learnt from how stances contradict each other."""

from dataclasses import replace

import numpy as np
import pytest

from coloc_graph.backend import joint
from coloc_graph.backend.shared_noise import learn_shared_noise, shared_part
from coloc_graph.geometry.lie import sl3_exp
from coloc_graph.measurements import RelativePose
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.run import open_run
from coloc_graph.simulation import Imperfections, simulate


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    path = tmp_path_factory.mktemp("shared") / "run.mcap"
    simulate("hallway", path, imperfections=Imperfections(noise_px=0.1), stances=14, points=60, seed=1)
    return solve(open_run(path), SolveOptions("smooth", odometry=False)).estimate.graph


def with_shared(graph, stated, true, seed=0):
    """The graph with shared errors that are stated and true, relative to the noise of each homography."""
    rng, measurements = np.random.default_rng(seed), []
    for one in (one for one in graph.measurements if isinstance(one, RelativePose)):
        h = one.homography
        noise = np.linalg.inv(h.information)
        off = true * np.linalg.cholesky(noise) @ rng.standard_normal(8)
        shared = stated**2 * noise
        changed = replace(
            h, H_j_i=h.H_j_i @ sl3_exp(off), information=np.linalg.inv(noise + shared), shared=(shared + shared.T) / 2
        )
        measurements.append(replace(one, homography=changed, spans=()))
    return replace(graph, measurements=tuple(measurements))


@pytest.mark.parametrize("true", [0.3, 1.0, 3.0])
def test_the_size_of_shared_errors_is_found(graph, true):
    made = with_shared(graph, 1.0, true)
    assert shared_part(made) == pytest.approx(0.5)
    learnt = learn_shared_noise(made, joint(made, reject=False).values, 4.0)
    # 14 stances of 8 numbers with 5 unknowns each: a factor of 1.3 where it is as large as the noise
    assert abs(np.log(learnt.size / true)) < 3 * np.log(learnt.factor)
    assert learnt.factor < (2.5 if true < 1 else 1.5)


def test_what_stances_cannot_tell_stays_as_it_is_stated(graph):
    made = with_shared(graph, 1e-3, 1e-3)
    learnt = learn_shared_noise(made, joint(made, reject=False).values, 2.0)
    assert learnt.size == pytest.approx(1.0, rel=0.02)
    assert learnt.factor == pytest.approx(2.0, rel=0.05)
