"""Resolve ROS tf: the pose of one frame in another, along the tree of frames, at the times of its transforms."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import se3, se3_inverse, so3_exp, so3_log

Array = NDArray[np.float64]


@dataclass(eq=False)
class Edge:
    """Poses of a frame in its `parent`: `times` [ns], `poses` (4, 4). A `static` one always has the last pose."""

    parent: str
    static: bool
    times: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)

    def at(self, ns: NDArray[np.int64]) -> Array:
        """Interpolate T_parent_frame (n, 4, 4) at times within the known ones, as tf does."""
        if self.static:
            return np.broadcast_to(self.poses[-1], (len(ns), 4, 4))
        times, first = np.unique(np.array(self.times, np.int64), return_index=True)
        T = np.array(self.poses)[first]
        before = np.clip(np.searchsorted(times, ns, side="right") - 1, 0, max(len(times) - 2, 0))
        after = np.minimum(before + 1, len(times) - 1)
        share = ((ns - times[before]) / np.maximum(times[after] - times[before], 1))[:, None]
        turn = so3_log(T[before, :3, :3].mT @ T[after, :3, :3])
        return se3(
            T[before, :3, :3] @ so3_exp(share * turn), T[before, :3, 3] + share * (T[after, :3, 3] - T[before, :3, 3])
        )


class Frames:
    """Tree of frames."""

    def __init__(self) -> None:
        self._edges: dict[str, Edge] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._edges or any(edge.parent == name for edge in self._edges.values())

    @property
    def names(self) -> list[str]:
        """Names of all frames."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def add(self, parent: str, child: str, ns: int, T_parent_child: Array, *, static: bool) -> None:
        """Add the pose of a frame in its parent at a time [ns]; a frame that changes its parent starts anew."""
        edge = self._edges.get(child)
        if edge is None or (edge.parent, edge.static) != (parent, static):
            edge = self._edges[child] = Edge(parent, static)
        edge.times.append(ns)
        edge.poses.append(T_parent_child)

    def poses(self, a: str, b: str) -> tuple[NDArray[np.int64], Array] | None:
        """Times [ns] (n,) and T_a_b (n, 4, 4) whenever a transform between a and b was sent and all are known.

        None if the two are not in one tree; times are () if nothing between them ever moves.
        """
        up_a, up_b = self._up(a), self._up(b)
        common = next((frame for frame in up_b if frame in up_a), None)
        if common is None:
            return None
        from_a, from_b = up_a[: up_a.index(common)], up_b[: up_b.index(common)]
        told = [self._edges[frame].times for frame in (*from_a, *from_b) if not self._edges[frame].static]
        ns = np.unique(np.array([one for times in told for one in times], np.int64))
        if told:
            ns = ns[(ns >= max(map(min, told))) & (ns <= min(map(max, told)))]
        return ns, se3_inverse(self._down(from_a, ns)) @ self._down(from_b, ns)

    def fixed(self, a: str, b: str) -> Array | None:
        """T_a_b (4, 4) of two frames tied by static transforms, None if they are not."""
        up_a, up_b = self._up(a), self._up(b)
        common = next((frame for frame in up_b if frame in up_a), None)
        if common is None:
            return None
        from_a, from_b = up_a[: up_a.index(common)], up_b[: up_b.index(common)]
        if not all(self._edges[frame].static for frame in (*from_a, *from_b)):
            return None
        at = np.zeros(1, np.int64)
        found: Array = np.asarray(se3_inverse(self._down(from_a, at)) @ self._down(from_b, at), float)[0]
        return found

    def _down(self, frames: list[str], ns: NDArray[np.int64]) -> Array:
        """Pose of the first of some frames in the parent of the last."""
        T = np.tile(np.eye(4), (len(ns), 1, 1))
        for frame in frames:
            T = self._edges[frame].at(ns) @ T
        return T

    def _up(self, frame: str) -> list[str]:
        """A frame, its parent, and so on to the root."""
        way = [frame]
        while way[-1] in self._edges and self._edges[way[-1]].parent not in way:
            way.append(self._edges[way[-1]].parent)
        return way
