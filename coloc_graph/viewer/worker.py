"""Thread that answers slow requests of the render thread, only the newest of each kind."""

import threading
import traceback
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from coloc_graph.errors import ColocError

MAX_ANSWERS = 96  # answers that are kept


@dataclass(frozen=True)
class Failure:
    """Reason for which there is no answer."""

    why: str


class Worker:
    """One thread that answers requests; `wake` is called at each answer."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._known: OrderedDict[Hashable, Any] = OrderedDict()
        self._asked: OrderedDict[str, tuple[Hashable, Callable[[], Any]]] = OrderedDict()
        self._changed = threading.Condition()
        self._ending = False
        self._thread = threading.Thread(target=self._work, name="viewer-worker", daemon=True)
        self._thread.start()

    def ask(self, kind: str, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return the answer, a `Failure`, or None while it is made. A newer request replaces one of its kind."""
        with self._changed:
            if (kind, key) in self._known:
                self._known.move_to_end((kind, key))
                return self._known[kind, key]
            self._asked[kind] = (key, make)
            self._changed.notify()
            return None

    def close(self) -> None:
        """End the thread after the question at hand."""
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._thread.join(timeout=10)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked or self._ending)
                if self._ending:
                    return
                kind, (key, make) = self._asked.popitem(last=False)
                if (kind, key) in self._known:
                    continue
            try:
                answer = make()
            except ColocError as error:
                answer = Failure(str(error))
            except Exception as error:  # a dead thread would look like images that never come
                traceback.print_exc()
                answer = Failure(f"{type(error).__name__}: {error}")
            with self._changed:
                self._known[kind, key] = answer
                while len(self._known) > MAX_ANSWERS:
                    self._known.popitem(last=False)
            self._wake()
