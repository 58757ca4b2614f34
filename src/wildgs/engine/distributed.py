"""Training on several processes (ranks): `torchrun --nproc-per-node K -m wildgs train ...`.

Data parallelism: every rank holds the whole model and trains on a different photo. Gradients and view statistics
are summed over the ranks and all decisions are the same everywhere, so that the models stay bitwise identical
(docs/scaling.md).
"""

from __future__ import annotations

import contextlib
import os
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch import distributed as dist

from wildgs import processes
from wildgs.engine.density import ViewStatistics
from wildgs.engine.team import DivergedRanksError, LostRankError, Team
from wildgs.errors import ReportedError, UserError, WildGSWarning
from wildgs.losses.objective import Losses
from wildgs.threads import thread_count

BUCKET_ELEMENTS = 1 << 22
"""Smaller tensors are sent in buckets of this to twice this number of elements (16 MB or more), since one message
per small tensor would be bound by latency."""


@torch.no_grad()
def sum_over_ranks(tensors: Sequence[Tensor]) -> None:
    """Replaces every tensor by its sum over all ranks, which is bitwise identical on all ranks.

    Large tensors are sent separately, small ones in flat buckets, all asynchronously.

    Args:
        tensors: Tensors with the same shapes in the same order on all ranks, in any memory layout; one dtype and
            device.
    """
    small = [tensor for tensor in tensors if tensor.numel() < BUCKET_ELEMENTS]
    sent: list[tuple[list[Tensor], Tensor]] = []
    for tensor in tensors:
        if tensor.numel() >= BUCKET_ELEMENTS:
            sent.append(([tensor], tensor if tensor.is_contiguous() else tensor.contiguous()))
    for bucket in _buckets(small):
        sent.append((bucket, torch.cat([tensor.reshape(-1) for tensor in bucket])))
    waiting = [dist.all_reduce(flat, op=dist.ReduceOp.SUM, async_op=True) for _, flat in sent]
    for work in waiting:
        if work is not None:
            work.wait()
    for bucket, flat in sent:
        if flat is not bucket[0]:
            for tensor, part in zip(bucket, flat.split([t.numel() for t in bucket]), strict=True):
                tensor.copy_(part.view(tensor.shape))


def _buckets(tensors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    bucket: list[Tensor] = []
    count = 0
    for tensor in tensors:
        bucket.append(tensor)
        count += tensor.numel()
        if count >= BUCKET_ELEMENTS:
            yield bucket
            bucket, count = [], 0
    if bucket:
        yield bucket


def raise_once(messages: Sequence[str | None], rank: int, own: UserError | None = None) -> None:
    """Stops all ranks if one of them failed, and reports the error once.

    Args:
        messages: The message of each rank's error; None for ranks without an error.
        rank: Rank of this process.
        own: The error of this rank.

    Raises:
        UserError: On rank 0: its own error, or that of the first failed rank.
        ReportedError: On the other ranks.
    """
    failed = [other for other, message in enumerate(messages) if message is not None]
    if not failed:
        return
    message = str(messages[failed[0]])
    if rank:
        raise ReportedError(message)
    raise own if own is not None else UserError(f"rank {failed[0]}: {message}")


Result = TypeVar("Result")

TIMEOUT = timedelta(minutes=10)
"""Timeout of communication. Compiling the CPU kernels and writing a checkpoint to a slow disk may take minutes."""


class Ranks(Team):
    """One of several processes; created by `join`."""

    def __init__(self, control: dist.ProcessGroup) -> None:
        """Creates the team.

        Args:
            control: A gloo group of all ranks for control messages. It detects a lost rank at once, while NCCL
                would wait for its timeout.
        """
        super().__init__()
        self.rank = dist.get_rank()
        self.size = dist.get_world_size()
        self._control = control
        self._stop_signal = 0

    @property
    def stop_signal(self) -> int:
        """The highest signal number that any rank received before the last step."""
        return self._stop_signal

    @contextmanager
    def propagate_errors(self) -> Iterator[None]:  # noqa: D102 - as in Team
        own: UserError | None = None
        with warnings.catch_warnings():
            if not self.first:
                warnings.simplefilter("ignore", WildGSWarning)
            try:
                yield
            except UserError as error:
                own = error
        raise_once(self._gather(None if own is None else str(own)), self.rank, own)

    def from_first(self, function: Callable[[], Result]) -> Result:  # noqa: D102 - as in Team
        result: list[Any] = [None]
        with self.propagate_errors():
            if self.first:
                result[0] = function()
        with _peers():
            dist.broadcast_object_list(result, src=0, group=self._control)
        return result[0]

    def least(self, value: int) -> int:  # noqa: D102 - as in Team
        return min(self._gather(value))

    def require_same(self, facts: Mapping[str, str]) -> None:  # noqa: D102 - as in Team
        gathered = self._gather(dict(facts))
        with self.propagate_errors():
            for name, value in gathered[0].items():
                others = [rank for rank, found in enumerate(gathered) if found.get(name) != value]
                if others:
                    raise UserError(
                        f"the ranks differ in their {name}: {value} on rank 0, {gathered[others[0]].get(name)} on "
                        f"rank {others[0]}; give all of them the same command, scene and versions"
                    )

    def share(self, tensors: Iterable[Tensor]) -> None:  # noqa: D102 - as in Team
        with _peers(), torch.no_grad():
            for tensor in tensors:
                whole = tensor.contiguous()
                dist.broadcast(whole, src=0)
                tensor.copy_(whole)

    def average(self, parameters: Iterable[Tensor], losses: Losses) -> Losses:  # noqa: D102 - as in Team
        trained = [parameter for parameter in parameters if parameter.requires_grad]
        self._exchange_control(trained)
        gradients = [parameter.grad for parameter in trained if parameter.grad is not None]
        terms = torch.stack([losses.image, losses.mask, losses.depth, losses.total]).detach().float()
        with _peers():
            sum_over_ranks([*gradients, terms])
        if gradients:
            torch._foreach_div_(gradients, self.size)  # pyright: ignore[reportPrivateImportUsage]
        image, mask, depth, total = (terms / self.size).unbind()
        return Losses(image=image, mask=mask, depth=depth, total=total)

    def _exchange_control(self, parameters: list[Tensor]) -> None:
        """Exchanges, before the gradients, which of them exist, the size of the model, and a signal to stop."""
        count = sum(parameter.numel() for parameter in parameters)
        present = [int(parameter.grad is not None) for parameter in parameters]
        state = torch.tensor([self.received_signal, count, -count, *present])
        with _peers():
            dist.all_reduce(state, op=dist.ReduceOp.MAX, group=self._control)
        self._stop_signal, most, least, *present = state.tolist()
        if most != -least:
            message = (
                f"the ranks' models differ in size ({-least:,} and {most:,} elements); --resume continues from the "
                "newest checkpoint"
            )
            raise DivergedRanksError(message) if self.first else ReportedError(message)
        for parameter, somewhere in zip(parameters, present, strict=True):
            if somewhere and parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)

    def pool(self, statistics: ViewStatistics) -> ViewStatistics:  # noqa: D102 - as in Team
        sums = torch.stack([statistics.demand, statistics.seen])
        largest = statistics.largest.clone()
        with _peers():
            sum_over_ranks([sums])
            dist.all_reduce(largest, op=dist.ReduceOp.MAX)
        return ViewStatistics(demand=sums[0], seen=sums[1], largest=largest)

    def exchange(self, label: int, value: Tensor) -> list[tuple[int, Tensor]]:  # noqa: D102 - as in Team
        labels = [torch.zeros(1, dtype=torch.int64) for _ in range(self.size)]
        values = [torch.empty_like(value) for _ in range(self.size)]
        with _peers():
            dist.all_gather(labels, torch.tensor([label]), group=self._control)
            dist.all_gather(values, value.contiguous())
        return [(int(each), found) for each, found in zip(labels, values, strict=True)]

    def _gather(self, value: Any) -> list[Any]:
        gathered: list[Any] = [None] * self.size
        with _peers():
            dist.all_gather_object(gathered, value, group=self._control)
        return gathered


@contextmanager
def _peers() -> Iterator[None]:
    """Converts connection errors to `LostRankError` on the rank that notices first, else `ReportedError`."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise
    except RuntimeError as error:
        reason = (str(error).splitlines() or [""])[0]
        message = (
            "another process of this training ended or does not answer, so all of them stop (torchrun reports "
            "below which one failed first); run the same command again (`wildgs train`: with --resume) to continue "
            f"from the newest checkpoint with any number of processes. Cause: {reason}"
        )
        raise (LostRankError(message) if _notices_first() else ReportedError(message)) from error


def _notices_first() -> bool:
    """Whether this is the first rank to notice, by a counter in torchrun's store, which outlives the ranks."""
    try:
        return dist.distributed_c10d._get_default_store().add("wildgs/lost", 1) == 1
    except RuntimeError:
        return True


@contextmanager
def join() -> Iterator[Team]:
    """Connects the processes that torchrun started; without torchrun, gives a team of one process.

    Raises:
        UserError: There are more processes than GPUs, or they cannot connect.
    """
    if processes.world_size() == 1:
        yield Team()
        return
    # Replaces pycolmap's handler, which would print a stack trace when torchrun stops the remaining processes.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    device = assign_device()
    try:
        if device.type == "cuda":
            dist.init_process_group("nccl", timeout=TIMEOUT, device_id=device)
        else:
            dist.init_process_group("gloo", timeout=TIMEOUT)
        control = dist.new_group(backend="gloo", timeout=TIMEOUT)
    except (RuntimeError, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise UserError(f"the processes cannot connect to each other: {reason}") from error
    assert isinstance(control, dist.ProcessGroup)
    agreed = False
    try:
        yield Ranks(control)
        agreed = True
    except KeyboardInterrupt:
        agreed = True
        raise
    finally:
        # After an error NCCL would wait for lost ranks.
        if agreed or device.type == "cpu":
            with contextlib.suppress(RuntimeError):
                dist.destroy_process_group()


def assign_device() -> torch.device:
    """Assigns this process its own GPU, and its share of the machine's cores.

    Raises:
        UserError: There are more processes than GPUs.
    """
    _share_cores()
    if not torch.cuda.is_available():
        return torch.device("cpu")
    count = torch.cuda.device_count()
    if processes.local_rank() >= count:
        raise UserError(
            f"this machine has {count} GPUs for {processes.local_world_size()} processes; "
            f"use --nproc-per-node {count}"
        )
    device = torch.device("cuda", processes.local_rank())
    torch.cuda.set_device(device)
    return device


def _share_cores() -> None:
    """Divides a machine's cores among its processes; torchrun limits each to one core by default."""
    if os.environ.get("OMP_NUM_THREADS", "1") != "1":
        return  # set by the user
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    share = max(1, cores // processes.local_world_size())
    torch.set_num_threads(thread_count() if "WILDGS_NUM_THREADS" in os.environ else share)
