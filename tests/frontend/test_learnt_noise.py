"""Noise of marker centres is learnt from residuals, with the stated one as a prior."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec import structs

from coloc_graph.backend.shared_noise import SharedNoise
from coloc_graph.frontend.homography.noise_components import NoiseEvidence, learn_components
from coloc_graph.frontend.homography.scatter import learn_spread, variance_factor
from coloc_graph.frontend.learnt_noise import NoiseBelief, measure_alone
from coloc_graph.pipeline.batch import IncrementalSolver, SolveOptions, solve
from coloc_graph.results.writer import write_result
from coloc_graph.run import RunWriter, open_run
from coloc_graph.simulation import Imperfections, simulate
from coloc_graph.team import CentreNoise, read_team

PRIOR = np.zeros(2), np.diag([4.0, 4.0])


def evidence(rng, n, variances, p=8):
    """Residuals of a fit of p unknowns to n points with two components, of which the second differs by point."""
    design = rng.standard_normal((n, 2, p))
    loads = np.stack([np.ones(n), rng.uniform(0, 4, n)])
    sigma = np.sqrt(variances @ loads)
    residual = sigma[:, None] * rng.standard_normal((n, 2))
    flat, weights = design.reshape(-1, p), np.repeat(sigma**-2, 2)
    h = np.linalg.solve(flat.T @ (weights[:, None] * flat), flat.T @ (weights * residual.ravel()))
    return NoiseEvidence(residual - design @ h, design, loads[:, :, None, None] * np.eye(2), np.arange(2))


def test_components_are_unbiased_though_fits_leave_few_degrees_of_freedom():
    # eight unknowns from ten points: without counting them variances would come out at 0.6 of what they are
    rng, true = np.random.default_rng(0), np.array([0.5, 2.0])
    logs, covariance = learn_components([evidence(rng, 10, true) for _ in range(400)], *PRIOR)
    off = (logs - np.log(true)) / np.sqrt(covariance.diagonal())
    assert np.abs(off).max() < 3
    assert np.sqrt(covariance.diagonal()).max() < 0.25


def test_one_fit_after_the_other_gives_what_all_together_do():
    rng = np.random.default_rng(1)
    every = [evidence(rng, 60, np.array([0.5, 2.0])) for _ in range(12)]
    together = learn_components(every, *PRIOR)
    belief = PRIOR
    for one in every:
        belief = learn_components([one], *belief)
    sigmas = np.sqrt(together[1].diagonal())
    assert np.abs(belief[0] - together[0]).max() < 0.7 * sigmas.max()
    assert np.sqrt(belief[1].diagonal()) == pytest.approx(sigmas, rel=0.2)


def scatters(rng, spread, fits=60, dof=62):
    """Degrees of freedom and chi2 of fits whose variances differ, and those variances."""
    variance = np.exp(spread * rng.standard_normal(fits))
    return variance * rng.chisquare(dof, fits), np.full(fits, float(dof)), variance


@pytest.mark.parametrize("spread", [0.05, 0.7])
def test_the_spread_of_fits_is_found(spread):
    chi2, dof, _ = scatters(np.random.default_rng(2), spread)
    median, factor = learn_spread(chi2, dof, 0.1, 0.2, 3.0)
    assert abs(np.log(median / spread)) < 2.5 * np.log(factor)
    assert factor < (2.5 if spread < 0.2 else 1.2)
    # a first fit cannot tell a noisy fit from a noisy run, unless the run's noise is known
    assert learn_spread(chi2[:1], dof[:1], 4.0, 0.2, 3.0) == pytest.approx((0.2, 3.0), rel=0.3)
    assert learn_spread(np.array([4 * 62.0]), dof[:1], 1e-4, 0.2, 3.0)[0] > 0.4


def test_a_fit_gets_its_own_variance_as_far_as_fits_differ():
    assert variance_factor(62 * 1.3, 62, 0.0) == 1.0  # chance
    assert variance_factor(62 * 2.0, 62, 0.0) == 2.0  # more than chance
    assert variance_factor(62 * 0.5, 62, 0.02) == pytest.approx(1.0, abs=0.05)
    seen, dof, _ = scatters(np.random.default_rng(3), 0.7, 400)
    # half of a fit's points tell what the variance of the other half is
    factors = np.array([variance_factor(*pair, 0.7) for pair in zip(seen, dof, strict=True)])
    _, _, variance = scatters(np.random.default_rng(3), 0.7, 400)
    assert (variance / factors).mean() == pytest.approx(1.0, abs=0.03)
    assert np.std(np.log(variance / factors)) < 0.25  # 0.7 without


@pytest.fixture(scope="module")
def hallway(tmp_path_factory):
    path = tmp_path_factory.mktemp("noise") / "run.mcap"
    simulate("hallway", path, imperfections=Imperfections(noise_px=0.3), stances=6, points=100, seed=3)
    return path


def restated(path, out, factor):
    """The run with all stated covariances of detections changed by a factor on their sigmas."""
    run = open_run(path)
    with RunWriter(out, run.team) as writer:
        for robot in run.team.names:
            if run.has_detections(robot):
                for one in run.detections(robot):
                    writer.write(replace(one, covariance=factor**2 * one.covariance))
        for stance in run.stances:
            writer.write(stance)
    return open_run(out)


@pytest.fixture(scope="module")
def solved(hallway, tmp_path_factory):
    """Solutions, by the factor between stated and true sigma, of the run without odometry."""

    @cache
    def solution(factor):
        path = tmp_path_factory.mktemp("restated") / "run.mcap"
        return solve(restated(hallway, path, factor), SolveOptions(odometry=False))

    return solution


@pytest.mark.parametrize("factor", [0.1, 1.0, 3.0])
def test_noise_is_found_whatever_is_stated(solved, factor):
    solution = solved(factor)
    noise = solution.noise
    for robot in ("A", "B"):
        sigma, within = noise.sigma(robot)
        assert within < 1.2
        assert sigma == pytest.approx(0.3, rel=0.15)
    used = [one.homography for one in solution.measurements]
    assert sum(one.chi2 for one in used) / sum(one.dof for one in used) == pytest.approx(1, abs=0.15)


def test_noise_that_changes_the_typical_centre_by_less_than_a_hundredth_is_the_same(hallway):
    belief = NoiseBelief.of(open_run(hallway).team)
    learnt = replace(belief, points=np.full(3, 500), typical=np.tile([0.09, 0.0], (3, 1)))
    assert not learnt.differs_from(learnt)
    floor = np.eye(len(belief.mean))[1]  # of the first camera
    for change, differs in ((0.1, False), (3.0, True)):
        other = replace(learnt, mean=learnt.mean + change * floor)
        assert other.differs_from(learnt) == differs


def test_a_short_run_keeps_what_is_stated_and_is_wide(hallway, solved):
    run = open_run(hallway)
    nothing, one = NoiseBelief.of(run.team), solved(1.0).noise
    stated = nothing.noise("A")
    assert stated.floor_px == pytest.approx(CentreNoise().floor_px)
    # of a floor that is known within a factor of three the variance is expected eleven times its median
    assert nothing.used(run.team)["A"].camera.centre_noise.variances[1] == pytest.approx(11.2 * 0.03**2, rel=0.01)
    assert one.noise("C").logs == nothing.noise("C").logs  # whose camera saw nothing
    assert one.noise("A").floor_factor > 1.5  # 0.3 px of stated noise tell little of a floor of 0.03


def test_a_pair_measured_alone_has_the_noise_that_a_run_of_it_has(hallway, tmp_path):
    run = restated(hallway, tmp_path / "run.mcap", 0.1)
    alone = measure_alone(run, run.stances[0], "A", "B")
    assert alone.fit.chi2 / alone.fit.dof == pytest.approx(1.0, abs=0.3)  # 100 as stated
    belief = NoiseBelief.of(run.team)
    assert belief.updated([alone]).sigma("A")[0] == pytest.approx(0.3, rel=0.25)
    assert alone.homography.shared is not None


def test_learnt_noise_is_in_the_team_that_a_result_writes_and_the_next_run_starts_from_it(solved, tmp_path):
    first = solved(0.1)
    write_result(first, tmp_path / "out")
    learnt = read_team(tmp_path / "out" / "team.toml")
    noise = learnt["A"].camera.centre_noise
    assert noise == structs.replace(first.noise.noise("A"), typical_px=first.noise.sigma("A")[0])
    assert learnt["A"].camera.typical_noise_px == pytest.approx(0.3, rel=0.15)
    assert learnt["C"].camera.typical_noise_px == learnt["C"].camera.noise_px  # whose camera saw nothing
    assert noise.floor_px == pytest.approx(0.3, rel=0.2)
    assert NoiseBelief.of(learnt).noise("A").floor_factor == pytest.approx(noise.floor_factor)
    rows = json.loads((tmp_path / "out" / "summary.json").read_text())["centre_noise"]
    assert {row["what"] for row in rows} == {
        "typical centre",
        "stated sigma times",
        "white floor",
        "shared in a stance",
        "log variance by stance",
    }
    assert "Noise of marker centres" in (tmp_path / "out" / "report.html").read_text()


def test_stance_by_stance_learns_about_the_same_as_all_at_once(solved):
    batch = solved(0.1).noise
    online = solve(solved(0.1).run, SolveOptions(odometry=False, incremental=True)).noise
    for robot in ("A", "B"):
        assert online.sigma(robot)[0] == pytest.approx(batch.sigma(robot)[0], rel=0.1)


def test_a_stance_that_is_withdrawn_takes_what_it_taught_with_it(hallway):
    run = open_run(hallway)
    solver = IncrementalSolver(run.team, SolveOptions(odometry=False))
    beliefs = []
    for stance in run.stances[:2]:
        solver.enter(run, stance)
        beliefs.append(solver.noise)
    solver.withdraw()
    assert solver.noise is beliefs[0]


def test_a_shared_error_with_which_a_pair_would_tell_nothing_is_not_taken(solved, monkeypatch):
    before = solved(1.0)
    monkeypatch.setattr("coloc_graph.pipeline.shared_errors.shared_noise_of", lambda *_: SharedNoise(1e4, 1.5))
    after = solve(before.run, SolveOptions(odometry=False))
    assert after.count.used == before.count.used
    np.testing.assert_allclose(after.estimate.chi2, before.estimate.chi2, rtol=0.1)
