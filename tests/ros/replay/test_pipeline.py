"""Reading ahead and writing behind: the same items in the same order, errors in their place."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from dyfn_ros.replay.pipeline import Behind, ahead


def test_items_come_in_order_and_at_most_so_many_ahead() -> None:
    made: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(50):
            made.append(number)
            yield number

    for taken in ahead(numbers(), depth=3):
        assert len(made) <= taken + 1 + 3 + 1  # those taken, those that wait, one in the making
    assert taken == 49 and made == list(range(50))


def test_an_error_of_the_source_comes_after_the_items_before_it() -> None:
    def broken() -> Iterator[int]:
        yield 1
        yield 2
        raise OSError("the disk is gone")

    taken = []
    with pytest.raises(OSError, match="the disk is gone"):
        for item in ahead(broken()):
            taken.append(item)
    assert taken == [1, 2]


def test_a_source_that_nobody_reads_on_is_closed_in_its_thread() -> None:
    where: list[threading.Thread] = []

    def endless() -> Iterator[int]:
        try:
            while True:
                yield 0
        finally:
            where.append(threading.current_thread())

    reading = ahead(endless())
    next(reading)
    reading.close()
    assert where and where[0] is not threading.current_thread()
    assert not where[0].is_alive()


def test_items_are_worked_on_in_order_before_the_block_ends() -> None:
    done: list[int] = []
    with Behind(done.append, depth=2) as behind:
        for number in range(50):
            behind.push(number)
    assert done == list(range(50))


@pytest.mark.parametrize("items", [1, 30])
def test_an_error_of_the_work_is_raised_and_nothing_is_done_after_it(items: int) -> None:
    done: list[int] = []

    def work(number: int) -> None:
        if number == 0:
            raise ValueError("no room")
        done.append(number)

    with pytest.raises(ValueError, match="no room"), Behind(work, depth=2) as behind:
        for number in range(items):
            behind.push(number)
    assert not done


def test_an_error_of_the_block_drops_what_waits() -> None:
    begun, go_on, done = threading.Event(), threading.Event(), []

    def work(number: int) -> None:
        begun.set()
        go_on.wait(10)
        done.append(number)

    with pytest.raises(KeyboardInterrupt), Behind(work, depth=8) as behind:
        for number in range(5):
            behind.push(number)
        assert begun.wait(10)
        threading.Timer(0.1, go_on.set).start()
        raise KeyboardInterrupt
    assert done == [0]
