"""What ranks exchange, without knowing what training is: sums over flat buckets, and errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch import distributed as dist

from wildgs.errors import ReportedError, UserError

BUCKET_ELEMENTS = 1 << 22
"""Tensors smaller than this travel together, in messages of at most about twice so many numbers: 16 MB and more
fill any network, and single messages for a network's hundreds of small tensors would wait for latency."""


@torch.no_grad()
def sum_over_ranks(tensors: Sequence[Tensor]) -> None:
    """Replaces every tensor by its sum over all ranks; afterwards all ranks hold the same bits.

    Large tensors travel as they are, small ones in flat buckets. All messages are under way at once.

    Args:
        tensors: Of the same shapes in the same order on all ranks, in any memory layout; one dtype and device.
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
    """Ends all ranks where one made a mistake, and tells it once.

    Args:
        messages: Every rank's mistake, None for those without.
        rank: This one.
        own: This rank's mistake.

    Raises:
        UserError: On rank 0: its own mistake, or the first other one and whose it is.
        ReportedError: On the other ranks.
    """
    failed = [other for other, message in enumerate(messages) if message is not None]
    if not failed:
        return
    message = str(messages[failed[0]])
    if rank:
        raise ReportedError(message)
    raise own if own is not None else UserError(f"rank {failed[0]}: {message}")
