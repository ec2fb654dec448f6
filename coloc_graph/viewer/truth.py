"""True poses of a run, as a layer."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from coloc_graph.errors import InputError
from coloc_graph.evaluation import Alignment, align, with_truth, without_truth
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run import Run, Stance, read_truth
from coloc_graph.viewer.scene import TRUE, Layer, layer_of


def true_layers(
    run: Run | None,
    robots: Sequence[str],
    stances: Sequence[Stance],
    estimated: Mapping[str, Trajectory],
    *,
    on_floor: bool,
    alignment: Alignment = "reference",
) -> tuple[tuple[Layer, ...], tuple[str, ...]]:
    """Return the layer of true poses in the estimate's world, at its times, if any; and notes on missing truth."""
    truth = read_truth(run.path, estimated) if run is not None and any(len(one) for one in estimated.values()) else {}
    if run is None or not truth:
        return (), ()
    try:
        true = align(estimated, truth, run.team.reference, on_floor=on_floor, alignment=alignment)
    except InputError as error:
        return (), (f"the truth in the run is not shown: {error}",)
    trajectories = {
        robot: replace(one, T_world_body=true[robot], covariances=None).where(with_truth(true[robot]))
        for robot, one in estimated.items()
    }
    return (layer_of(TRUE, robots, stances, trajectories),), without_truth(estimated, true)
