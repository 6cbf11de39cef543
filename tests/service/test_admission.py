"""The queue by itself."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack

import pytest

from service.admission import Admission
from service.errors import QueueFullError
from service.pace import LONGEST_RETRY_SECONDS, Pace


def test_places_are_workers_and_queue_and_come_back() -> None:
    admission = Admission(workers=2, queue_size=3)
    for _ in range(2):
        with ExitStack() as stack:
            for _ in range(5):
                stack.enter_context(admission.place())
            with pytest.raises(QueueFullError) as caught, admission.place():
                pass
            assert (caught.value.limit, caught.value.actual) == (5, 6)
        assert admission.held == 0


def test_a_place_comes_back_after_an_error() -> None:
    admission = Admission(workers=1, queue_size=0)
    with pytest.raises(ZeroDivisionError), admission.place():
        raise ZeroDivisionError
    assert admission.held == 0


def test_workers_are_given_in_order_and_never_more_than_there_are() -> None:
    admission = Admission(workers=2, queue_size=100)
    order: list[int] = []
    most = 0

    async def one(number: int) -> None:
        nonlocal most
        async with admission.worker():
            order.append(number)
            most = max(most, admission.running)
            await asyncio.sleep(0.001)

    async def play() -> None:
        await asyncio.gather(*(one(number) for number in range(20)))

    asyncio.run(play())
    assert order == list(range(20))
    assert most == 2
    assert (admission.running, admission.waiting) == (0, 0)


def test_small_ones_have_a_worker_more() -> None:
    admission = Admission(workers=1, queue_size=10, express=1)
    order: list[str] = []

    async def one(name: str, small: bool, until: asyncio.Event) -> None:
        async with admission.worker(small):
            order.append(name)
            await until.wait()

    async def play() -> None:
        end = asyncio.Event()
        work = [
            asyncio.create_task(one(name, name.startswith("small"), end))
            for name in ("large 1", "large 2", "small 1", "small 2")
        ]
        await asyncio.sleep(0.02)
        assert order == ["large 1", "small 1"]
        assert admission.waiting == 2
        end.set()
        await asyncio.gather(*work)
        assert order == ["large 1", "small 1", "large 2", "small 2"]

    asyncio.run(play())


def test_one_who_gives_up_in_the_moment_when_a_worker_falls_free() -> None:
    admission = Admission(workers=1, queue_size=10)

    async def hold(end: asyncio.Event) -> None:
        async with admission.worker():
            await end.wait()

    async def play() -> None:
        end = asyncio.Event()
        first = asyncio.create_task(hold(end))
        await asyncio.sleep(0)
        second, third = (asyncio.create_task(hold(end)) for _ in range(2))
        await asyncio.sleep(0.01)
        assert admission.waiting == 2
        end.set()
        second.cancel()  # before the first one comes round to giving its worker back
        await asyncio.gather(first, third)
        with pytest.raises(asyncio.CancelledError):
            await second
        assert (admission.running, admission.waiting) == (0, 0)
        async with asyncio.timeout(1), admission.worker():
            pass

    asyncio.run(play())


def test_one_who_gives_up_waiting_takes_no_worker() -> None:
    admission = Admission(workers=1, queue_size=5)

    async def play() -> None:
        async with admission.worker():
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.02), admission.worker():
                    pytest.fail("there is only one worker")
            assert admission.waiting == 0
        async with asyncio.timeout(1), admission.worker():
            assert admission.running == 1

    asyncio.run(play())


def test_retry_after_follows_the_measured_rate() -> None:
    pace = Pace(workers=2)
    guess = pace.retry_after()
    assert guess >= 1
    for _ in range(60):
        pace.note(40.0)
    assert pace.retry_after() == 20
    for _ in range(60):
        pace.note(0.001)
    assert pace.retry_after() == 1
    for _ in range(60):
        pace.note(1e6)
    assert pace.retry_after() == LONGEST_RETRY_SECONDS


def test_a_file_that_is_refused_says_nothing_about_the_rate() -> None:
    admission = Admission(workers=1, queue_size=5)
    before = admission.retry_after()

    async def play() -> None:
        with pytest.raises(ValueError, match="no ply"):
            async with admission.worker():
                raise ValueError("no ply")
        assert admission.running == 0

    asyncio.run(play())
    assert admission.retry_after() == before
