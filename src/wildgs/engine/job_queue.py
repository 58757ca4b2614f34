"""Independent jobs, taken one by one by the processes that torchrun started.

Nothing is exchanged but counters in torchrun's own store: whoever is free takes the next job, so that long and
short ones spread themselves, and no process waits for another before the end.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import timedelta
from typing import Any

from torch.distributed import PrefixStore, Store  # pyright: ignore[reportPrivateImportUsage]
from torch.distributed.rendezvous import rendezvous

from wildgs import processes
from wildgs.errors import UserError

POLL_SECONDS = 0.5
CONNECT = timedelta(minutes=5)


class JobQueue:
    """The numbers of jobs, each handed to one process; without torchrun, to this one."""

    def __init__(self, name: str) -> None:
        """Joins the processes that torchrun started.

        Args:
            name: Of the queue; all processes give the same one.

        Raises:
            UserError: The processes find no connection to each other.
        """
        self._store: Store | None = None
        if processes.world_size() == 1:
            return
        try:
            store, _, _ = next(iter(rendezvous("env://", timeout=CONNECT)))
        except (RuntimeError, ValueError) as error:
            reason = (str(error).splitlines() or [""])[0]
            raise UserError(f"the processes find no connection to each other: {reason}") from error
        self._store = PrefixStore(f"wildgs/{name}", store)

    @property
    def first(self) -> bool:
        """Whether this process speaks for all."""
        return processes.rank() == 0

    def take(self, count: int) -> Iterator[int]:
        """Numbers below `count` that no other process has taken, until none is left."""
        if self._store is None:
            yield from range(count)
            return
        while (number := self._store.add("next", 1) - 1) < count:
            yield number

    def gather(self, what: str, own: Any) -> list[Any]:
        """Waits until every process has come here; what each of them brings, in the order of ranks.

        Waiting has no limit: the last job may take hours, and torchrun ends all if a process is lost.

        Args:
            what: Name of this meeting; every meeting has its own.
            own: What this process brings; JSON has to know it.
        """
        if self._store is None:
            return [own]
        self._store.set(f"{what}/{processes.rank()}", json.dumps(own))
        self._wait_for_all(f"{what}/brought")
        gathered = [json.loads(self._store.get(f"{what}/{rank}")) for rank in range(processes.world_size())]
        self._wait_for_all(f"{what}/read")  # a store may end with the process that keeps it
        return gathered

    def _wait_for_all(self, counter: str) -> None:
        assert self._store is not None
        self._store.add(counter, 1)
        while self._store.add(counter, 0) < processes.world_size():
            time.sleep(POLL_SECONDS)
