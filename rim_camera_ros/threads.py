"""Independent pieces of work on several threads, their results in the order of the pieces."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

#: More threads than this wait for the one that predicts.
_MOST = 4


def available() -> int:
    """Return how many threads a work may take: the cores that this process may use, four at most."""
    # not on every system
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return min(cores, _MOST)


def in_order[Item, Result](
    work: Callable[[Item], Result], items: Iterable[Item], *, threads: int = 1
) -> Iterator[Result]:
    """Yield the results of the work for each item, in the order of the items whatever the threads do.

    Items are taken in the calling thread, so many ahead of the results as there are threads: what is summed
    over the results is the same to the last bit with any number of threads. With one thread the work is done
    in the calling thread.
    """
    if threads < 2:
        yield from map(work, items)
        return
    # how numpy warns belongs to the thread
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
