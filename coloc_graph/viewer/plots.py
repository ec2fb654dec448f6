"""Curves over the stances, with a cursor where the slider is. Without NaN: uPlot draws nothing where there is one."""

import numpy as np

from coloc_graph.viewer.scene import Array, Scene

MAX_POINTS = 400  # points of a curve


def residual_curves(scene: Scene) -> tuple[Array, Array]:
    """Stance numbers (n,) and the largest residual of each, (1, n) [sigma]; (2, n) in a comparison."""
    every = (scene.edges,) if scene.beside is None else (scene.edges, scene.other_edges)
    if not len(scene):
        return np.zeros(1), np.zeros((len(every), 1))
    x, filled = _numbers(scene), np.zeros((len(every), len(scene)))
    for n, edges in enumerate(every):
        known = np.isfinite(edges.sigmas) & edges.used
        if known.any():
            rows, first = np.unique(edges.rows[known], return_index=True)
            filled[n] = np.interp(x, x[rows], np.maximum.reduceat(edges.sigmas[known], first))
    return _thinned(x, filled)


def error_curves(scene: Scene) -> tuple[Array, Array]:
    """Stance numbers (n,) and position error of each robot, (r, n) [mm]; without truth, its sigma.

    In a comparison (2 r, n): those of the other result follow.
    """
    r = len(scene.robots) * (1 if scene.beside is None else 2)
    if not scene.layers or not len(scene):
        return np.zeros(1), np.zeros((r, 1))
    layers = [scene.layers[0], *([] if scene.other is None else [scene.other])]
    values = np.concatenate(
        [
            scene.errors(one) if scene.true is not None else np.sqrt(one.covariance.trace(axis1=2, axis2=3).clip(min=0))
            for one in layers
        ]
    )
    x, filled = _numbers(scene), np.zeros((r, len(scene)))
    for n in range(r):
        known = np.isfinite(values[n])
        if known.any():
            filled[n] = np.interp(x, x[known], 1000 * values[n][known])
    return _thinned(x, filled)


def with_cursor(x: Array, curves: Array, at: float) -> tuple[Array, ...]:
    """x, the curves, and one more that is a vertical line at `at`: three points there, of which the middle is high."""
    curves = np.atleast_2d(curves)
    at_row = int(np.searchsorted(x, at))
    high = max(float(curves.max(initial=0.0)), 1e-9)
    here = [np.full(3, np.interp(at, x, curve)) for curve in curves]
    spike = np.zeros(len(x) + 3)
    spike[at_row + 1] = high
    return (
        np.insert(x, at_row, [at] * 3),
        *(np.concatenate([c[:at_row], h, c[at_row:]]) for c, h in zip(curves, here, strict=True)),
        spike,
    )


def _numbers(scene: Scene) -> Array:
    return np.array([stance.index for stance in scene.stances], float)


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """At most `MAX_POINTS`, the largest of each stretch."""
    if len(x) <= MAX_POINTS:
        return x, y
    edges = np.linspace(0, len(x), MAX_POINTS + 1).astype(int)[:-1]
    return x[edges], np.maximum.reduceat(y, edges, axis=-1)
