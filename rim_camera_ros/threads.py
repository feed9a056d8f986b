"""Independent items of work on several threads, with results in the order of the items."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

#: Most threads; more would only wait for the one that predicts.
_MOST = 4


def available() -> int:
    """Return the number of threads for a work: the cores that this process may use, four at most."""
    # not available on every system
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return min(cores, _MOST)


def in_order[Item, Result](
    work: Callable[[Item], Result], items: Iterable[Item], *, threads: int = 1
) -> Iterator[Result]:
    """Yield the results of the work for each item, always in the order of the items.

    Items are taken in the calling thread, ahead of the results by the number of threads. Sums over results
    are therefore identical to the last bit with any number of threads. With one thread the work is done in
    the calling thread.
    """
    if threads < 2:
        yield from map(work, items)
        return
    # numpy's treatment of floating-point errors is set per thread
    warnings = np.geterr()

    def done(item: Item) -> Result:
        with np.errstate(**warnings):
            return work(item)

    with ThreadPoolExecutor(threads, thread_name_prefix="station") as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(done, item))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
