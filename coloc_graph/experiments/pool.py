"""Work spread over processes, in order; and the checks that all experiments share."""

from collections.abc import Callable, Sequence
from typing import TypeVar, get_args

from coloc_graph.errors import InputError
from coloc_graph.results.executors import workers
from coloc_graph.simulation.world import Depth

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Called with how many parts of the work are done, and of how many.
Progress = Callable[[int, int], None]


def spread(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    processes: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> list[Result]:
    """Return the results of `work` on each item, in the order of the items.

    By spawned processes, in this process where `processes` is 1, or by the Dask scheduler at the address `cluster`. A
    script that calls this with several needs the usual `if __name__ == "__main__":`. The first error of any item ends
    all and is raised here.
    """
    results: list[Result] = []

    def take(result: Result) -> None:
        results.append(result)
        if progress is not None:
            progress(len(results), len(items))

    if cluster is None and min(processes, len(items)) <= 1:
        for item in items:
            take(work(item))
        return results
    with workers(processes, cluster) as executor:
        for future in [executor.submit(work, item) for item in items]:
            take(future.result())
    return results


def check(depth: str, seed: int, runs: int, processes: int) -> None:
    """Raise `InputError` where an argument that all experiments have is wrong."""
    if depth not in get_args(Depth):
        raise InputError(f"`depth` is {depth!r}; use tracks or images")
    if seed < 0:
        raise InputError(f"`seed` is {seed}; give a whole number that is not negative")
    if runs < 1:
        raise InputError(f"`runs` is {runs}; give at least 1")
    if processes < 1:
        raise InputError(f"`processes` is {processes}; give at least 1")
