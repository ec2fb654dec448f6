"""Executors of parallel work: processes of this machine, or a Dask cluster."""

import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

import cv2

from coloc_graph.errors import InputError

CONNECT_TIMEOUT = 10.0  # s, to connect to a cluster


@contextmanager
def workers(processes: int = 1, cluster: str | None = None) -> Iterator[Executor]:
    """Yield an executor; work that has not begun when the block is left is cancelled.

    Parameters
    ----------
    processes : int
        Number of spawned processes; a script that calls this needs the usual `if __name__ == "__main__":`.
    cluster : str or None
        Address of a Dask scheduler, used instead.

    Raises
    ------
    InputError
        There is no such cluster, or Dask is not installed.
    """
    if cluster is not None:
        with _dask(cluster) as executor:
            yield executor
        return
    if processes < 1:
        raise InputError(f"`processes` is {processes}; give at least 1")
    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_begin)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _dask(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(
            "a cluster needs Dask, which is not installed here: pip install 'coloc-graph[cluster]'"
        ) from error
    try:
        client: Any = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"there is no Dask scheduler at {address} ({error}): start one with `dask scheduler`, and give its address"
        ) from error
    try:
        yield client.get_executor(pure=False)
    finally:
        client.close()


def _begin() -> None:
    cv2.setNumThreads(1)  # the processes are parallel already
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends a worker without a traceback of its own
