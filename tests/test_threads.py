"""`wildgs.threads.infer_each`: different items on different threads, with the same results as one by one."""

from __future__ import annotations

import threading

import pytest
import torch

from wildgs.threads import infer_each, kernels_limited, limited, thread_count

CPU = torch.device("cpu")


def test_items_are_computed_at_once_and_come_in_order() -> None:
    both = threading.Barrier(2, timeout=30)

    def meet(number: int) -> tuple[int, int, bool]:
        both.wait()  # breaks unless two items are computed at the same time
        return number, thread_count(), torch.is_grad_enabled()

    with limited(2):
        assert list(infer_each(meet, range(6), CPU)) == [(number, 1, False) for number in range(6)]
        assert thread_count() == torch.get_num_threads() == 2
    assert torch.is_grad_enabled()


def test_results_that_nobody_takes_are_not_computed_ahead() -> None:
    begun = []
    with limited(2):
        results = infer_each(lambda number: begun.append(number) or number, range(100), CPU)
        assert next(results) == 0
        assert len(begun) <= 3
        results.close()
        assert thread_count() == 2
    assert len(begun) <= 3


def test_an_error_ends_it() -> None:
    def fail(number: int) -> int:
        return 1 // (3 - number)

    with limited(2):
        with pytest.raises(ZeroDivisionError):
            list(infer_each(fail, range(9), CPU))
        assert thread_count() == torch.get_num_threads() == 2


def test_kernels_may_have_more_threads_than_torch() -> None:
    with limited(1), kernels_limited(3):
        assert thread_count() == 3
        assert torch.get_num_threads() == 1
