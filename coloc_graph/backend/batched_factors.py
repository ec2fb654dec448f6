"""GTSAM factors of numpy models, evaluated one by one or in batches.

GTSAM calls one Python factor after the other, and numpy takes as long for one as for thirty. The first factor that is
called at some values therefore evaluates all of them there; the others look up their part.
"""

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.camera_model import UNEVALUABLE, BatchModel, Model

Array = NDArray[np.float64]

MAX_BATCH_SIZE = 256  # factors evaluated in one call; more take memory and are no faster each


class FactorEvaluator:
    """Callback of a `gtsam.CustomFactor`: residual and Jacobians of a model.

    Parameters
    ----------
    model
        The measurement model.
    poses
        Keys of the two poses it is on.
    keys
        Keys of its calibration variables; a variable without a key is 0.
    sizes
        Dimensions of these variables.
    """

    def __init__(self, model: Model, poses: tuple[int, int], keys: Sequence[int | None], sizes: Sequence[int]) -> None:
        self.model, self.poses, self.keys, self.sizes = model, poses, tuple(keys), tuple(sizes)
        self.variable = [(number, key) for number, key in enumerate(keys) if key is not None]
        #: Factors with which it is evaluated; None: it is evaluated alone.
        self.among: BatchedFactors | None = None
        self._alone: BatchModel | None = None

    @property
    def kind(self) -> Hashable:
        """Kind of factors that are evaluated in one batch."""
        return self.model.kind, self.sizes

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        """Whitened residual (rows,); fills the Jacobians that GTSAM passes."""
        found = self.among.at(self, values) if self.among is not None else None
        e, by = self.alone(values) if found is None else found
        if jacobians is not None:
            jacobians[0], jacobians[1] = by[0], by[1]
            for slot, (number, _key) in enumerate(self.variable, start=2):
                jacobians[slot] = by[2 + number]
        return e

    def alone(self, values: gtsam.Values) -> tuple[Array, list[Array]]:
        """Whitened residual (rows,), and its Jacobians (rows, size) by both poses and every variable."""
        if self._alone is None:
            self._alone = self.model.batch([self.model])
        errors = [np.zeros((1, size)) for size in self.sizes]
        for number, key in self.variable:
            errors[number] = values.atVector(key)[None]
        T_i, T_j = (values.atPose3(key).matrix()[None] for key in self.poses)
        e, by = _evaluated(self._alone, T_i, T_j, errors)
        return e[0], [one[0] for one in by]


class BatchedFactor(gtsam.CustomFactor):
    """GTSAM factor of a `FactorEvaluator`, with unit noise."""

    def __init__(self, evaluator: FactorEvaluator) -> None:
        unit = gtsam.noiseModel.Unit.Create(evaluator.model.rows)
        super().__init__(unit, [*evaluator.poses, *(key for _, key in evaluator.variable)], evaluator)
        self.evaluator = evaluator


def _evaluated(models: BatchModel, T_i: Array, T_j: Array, errors: Sequence[Array]) -> tuple[Array, list[Array]]:
    e, by, possible = models.at(T_i, T_j, errors)
    if not possible.all():
        # a large residual without gradient: the search neither goes there nor is led by it
        e[~possible] = UNEVALUABLE
        for one in by:
            one[~possible] = 0.0
    return e, by


class Group:
    """Factors of one kind."""

    def __init__(self, members: Sequence[FactorEvaluator]) -> None:
        self.members = members
        self._models = members[0].model.batch([one.model for one in members])

    def evaluated(self, T_i: Array, T_j: Array, errors: Callable[[int], Array]) -> tuple[Array, list[Array]]:
        """Residuals (n, rows) and their Jacobians at poses (n, 4, 4) and calibration variables `errors`, by key."""
        slots = []
        for number, size in enumerate(self.members[0].sizes):
            slot = np.zeros((len(self.members), size))
            for row, one in enumerate(self.members):
                key = one.keys[number]
                if key is not None:
                    slot[row] = errors(key)
            slots.append(slot)
        return _evaluated(self._models, T_i, T_j, slots)


class BatchedFactors:
    """Context manager within which factors are evaluated in batches."""

    def __init__(self, members: Sequence[FactorEvaluator]) -> None:
        self.members = tuple(members)
        self._poses = list(dict.fromkeys(key for one in members for key in one.poses))
        self._variables = sorted({key for one in members for _, key in one.variable})
        indices = {key: index for index, key in enumerate(self._poses)}
        kinds: dict[Hashable, list[FactorEvaluator]] = defaultdict(list)
        for one in members:
            kinds[one.kind].append(one)
        self._groups = [
            Group(some[first : first + MAX_BATCH_SIZE])
            for some in kinds.values()
            for first in range(0, len(some), MAX_BATCH_SIZE)
        ]
        self._index = {
            id(one): (n, row) for n, group in enumerate(self._groups) for row, one in enumerate(group.members)
        }
        self._ends = [
            [np.array([indices[one.poses[end]] for one in group.members]) for end in (0, 1)] for group in self._groups
        ]
        self._values: dict[int, bytes] = {}  # poses and calibration variables of the last evaluation
        self._found: list[tuple[Array, list[Array]]] = []
        self._before: list[BatchedFactors | None] = []
        self._held = False

    @property
    def keys(self) -> tuple[int, ...]:
        """Keys of all poses and calibration variables."""
        return *self._poses, *self._variables

    def __enter__(self) -> "BatchedFactors":
        self._before = [one.among for one in self.members]
        for one in self.members:
            one.among = self
        return self

    def __exit__(
        self, kind: type[BaseException] | None, why: BaseException | None, where: TracebackType | None
    ) -> None:
        for one, before in zip(self.members, self._before, strict=True):
            one.among = before

    @contextmanager
    def held(self, values: gtsam.Values) -> Iterator[None]:
        """Within this context all factors are evaluated at `values`, which are not compared with the last ones."""
        self._evaluate(values)
        self._held = True
        try:
            yield
        finally:
            self._held = False

    def at(self, member: FactorEvaluator, values: gtsam.Values) -> tuple[Array, list[Array]] | None:
        """Result of `FactorEvaluator.alone`, from the batch; None where the values lack a variable of the graph."""
        if not self._held and not self._is_current(member, values):
            if not all(map(values.exists, (*self._poses, *self._variables))):
                return None
            self._evaluate(values)
        group, row = self._index[id(member)]
        e, by = self._found[group]
        return e[row], [one[row] for one in by]

    def _is_current(self, member: FactorEvaluator, values: gtsam.Values) -> bool:
        """True if a member's variables are those of the last evaluation."""
        where = self._values
        return all(values.atPose3(key).matrix().tobytes() == where.get(key) for key in member.poses) and all(
            values.atVector(key).tobytes() == where.get(key) for _, key in member.variable
        )

    def _evaluate(self, values: gtsam.Values) -> None:
        poses = [values.atPose3(key).matrix() for key in self._poses]
        errors = {key: values.atVector(key) for key in self._variables}
        where = {key: T.tobytes() for key, T in zip(self._poses, poses, strict=True)}
        where |= {key: one.tobytes() for key, one in errors.items()}
        if where == self._values:
            return
        every = np.array(poses)
        self._found = [
            group.evaluated(every[i], every[j], errors.__getitem__)
            for group, (i, j) in zip(self._groups, self._ends, strict=True)
        ]
        self._values = where
