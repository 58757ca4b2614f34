"""Of each kind of work only the newest request counts, and one thread does it all."""

from __future__ import annotations

import threading

from wildgs.viewer.jobs import Jobs, start_worker


def test_newest_of_a_kind_replaces_the_waiting_one() -> None:
    jobs, done = Jobs(), []
    for value in range(5):
        jobs.put("light", lambda value=value: done.append(value))
    jobs.put("photo", lambda: done.append("photo"))
    while (job := jobs.take(wait=False)) is not None:
        job()
    assert done == [4, "photo"]


def test_worker_does_what_comes_and_ends_with_the_queue() -> None:
    jobs, done, came = Jobs(), [], threading.Event()
    worker = start_worker(jobs)
    jobs.put("a", lambda: done.append(threading.current_thread().name))
    jobs.put("b", came.set)
    assert came.wait(20)
    assert done == [worker.name]
    jobs.close()
    worker.join(20)
    assert not worker.is_alive()


def test_closed_queue_takes_nothing() -> None:
    jobs = Jobs()
    jobs.put("a", lambda: None)
    jobs.close()
    jobs.put("b", lambda: None)
    assert jobs.take(wait=False) is None
    assert jobs.take(wait=True) is None
