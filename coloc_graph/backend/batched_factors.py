"""GTSAM factors of a model in numpy, each evaluated alone, or all of a graph at once.

GTSAM asks one Python factor after the other; numpy takes as long for one as for thirty. So whoever is asked first at
some values evaluates all of them there, and the others find their part.
"""

from collections import defaultdict
from collections.abc import Hashable, Sequence
from types import TracebackType

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.camera_model import BEYOND, Model, Together

Array = NDArray[np.float64]

#: So many are evaluated in one go: more take memory, and are no faster each.
MOST = 256


class Seen:
    """What a factor evaluates: a model, on two poses and those of its variables that have a key; the others are 0."""

    def __init__(self, model: Model, poses: tuple[int, int], keys: Sequence[int | None], sizes: Sequence[int]) -> None:
        self.model, self.poses, self.keys, self.sizes = model, poses, tuple(keys), tuple(sizes)
        self.variable = [(number, key) for number, key in enumerate(keys) if key is not None]
        #: With whom it is evaluated; None: alone.
        self.among: BatchedFactors | None = None
        self._alone: Together | None = None

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        """The whitened residual (rows,), as GTSAM asks for it."""
        found = self.among.at(self, values) if self.among is not None else None
        e, by = self.alone(values) if found is None else found
        if jacobians is not None:
            jacobians[0], jacobians[1] = by[0], by[1]
            for place, (number, _key) in enumerate(self.variable, start=2):
                jacobians[place] = by[2 + number]
        return e

    def alone(self, values: gtsam.Values) -> tuple[Array, list[Array]]:
        """The whitened residual (rows,), and its Jacobians (rows, size) by both poses and every variable."""
        if self._alone is None:
            self._alone = self.model.together([self.model])
        errors = [np.zeros((1, size)) for size in self.sizes]
        for number, key in self.variable:
            errors[number] = values.atVector(key)[None]
        T_i, T_j = (values.atPose3(key).matrix()[None] for key in self.poses)
        e, by = _evaluated(self._alone, T_i, T_j, errors)
        return e[0], [one[0] for one in by]


class BatchedFactor(gtsam.CustomFactor):
    """The GTSAM factor of what was `seen`."""

    def __init__(self, seen: Seen) -> None:
        unit = gtsam.noiseModel.Unit.Create(seen.model.rows)
        super().__init__(unit, [*seen.poses, *(key for _, key in seen.variable)], seen)
        self.seen = seen


def _evaluated(models: Together, T_i: Array, T_j: Array, errors: Sequence[Array]) -> tuple[Array, list[Array]]:
    e, by, possible = models.at(T_i, T_j, errors)
    if not possible.all():
        # so far off that no search goes there, and flat, so that none is led on by it
        e[~possible] = BEYOND
        for one in by:
            one[~possible] = 0.0
    return e, by


class _Group:
    """Some of one kind, and where their poses are among those of all."""

    def __init__(self, members: Sequence[Seen], places: dict[int, int]) -> None:
        self.members = members
        self._models = members[0].model.together([one.model for one in members])
        self._ends = [np.array([places[one.poses[end]] for one in members]) for end in (0, 1)]

    def at(self, poses: Array, errors: dict[int, Array]) -> tuple[Array, list[Array]]:
        """The residuals (n, rows) and their Jacobians, with the errors of the variables by their keys."""
        slots = []
        for number, size in enumerate(self.members[0].sizes):
            slot = np.zeros((len(self.members), size))
            for row, one in enumerate(self.members):
                key = one.keys[number]
                if key is not None:
                    slot[row] = errors[key]
            slots.append(slot)
        return _evaluated(self._models, poses[self._ends[0]], poses[self._ends[1]], slots)


class BatchedFactors:
    """Factors that are evaluated at once, as long as it is entered (`with`)."""

    def __init__(self, members: Sequence[Seen]) -> None:
        self._members = members
        self._poses = list(dict.fromkeys(key for one in members for key in one.poses))
        self._variables = sorted({key for one in members for _, key in one.variable})
        places = {key: place for place, key in enumerate(self._poses)}
        kinds: dict[Hashable, list[Seen]] = defaultdict(list)
        for one in members:
            kinds[one.model.kind, one.sizes].append(one)
        self._groups = [
            _Group(some[first : first + MOST], places) for some in kinds.values() for first in range(0, len(some), MOST)
        ]
        self._place = {
            id(one): (n, row) for n, group in enumerate(self._groups) for row, one in enumerate(group.members)
        }
        self._where: dict[int, bytes] = {}  # at which poses and errors all were evaluated last
        self._found: list[tuple[Array, list[Array]]] = []

    def __enter__(self) -> "BatchedFactors":
        for one in self._members:
            one.among = self
        return self

    def __exit__(
        self, kind: type[BaseException] | None, why: BaseException | None, where: TracebackType | None
    ) -> None:
        for one in self._members:
            one.among = None

    def at(self, member: Seen, values: gtsam.Values) -> tuple[Array, list[Array]] | None:
        """What `Seen.alone` gives; None where the values are not those of the whole graph."""
        if not self._is_where(member, values):
            if not all(map(values.exists, (*self._poses, *self._variables))):
                return None
            self._evaluate(values)
        group, row = self._place[id(member)]
        e, by = self._found[group]
        return e[row], [one[row] for one in by]

    def _is_where(self, member: Seen, values: gtsam.Values) -> bool:
        """Whether a member is asked for where all were evaluated last."""
        where = self._where
        return all(values.atPose3(key).matrix().tobytes() == where.get(key) for key in member.poses) and all(
            values.atVector(key).tobytes() == where.get(key) for _, key in member.variable
        )

    def _evaluate(self, values: gtsam.Values) -> None:
        poses = [values.atPose3(key).matrix() for key in self._poses]
        errors = {key: values.atVector(key) for key in self._variables}
        self._found = [group.at(np.array(poses), errors) for group in self._groups]
        self._where = {key: T.tobytes() for key, T in zip(self._poses, poses, strict=True)}
        self._where |= {key: one.tobytes() for key, one in errors.items()}
