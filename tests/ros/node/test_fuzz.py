"""Random messages on every input topic: none ends anything, and depth is good afterwards."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.support.faults.bench import Bench
from tests.support.faults.fuzz import Taken, Topic, counted, fuzz, fuzzed_bench, topics, well
from tests.support.ros_graph import own_domain

TOPICS = topics()
FEW = 40
MANY = int(os.environ.get("DYFN_FUZZ", "200"))


@pytest.fixture(scope="module")
def fuzzed() -> Iterator[tuple[Bench, Taken]]:
    """A node that subscribes every kind of topic, and what its callbacks take."""
    with counted() as taken, own_domain() as domain, fuzzed_bench(domain) as bench:
        yield bench, taken


def check(fuzzed: tuple[Bench, Taken], topic: Topic, count: int, seed: int) -> None:
    bench, taken = fuzzed
    found = fuzz(bench, topic, count, taken, seed)
    assert found.sent == count
    assert found.received > count / 2
    well(bench, topic.camera)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_random_messages_are_survived(fuzzed: tuple[Bench, Taken], topic: Topic) -> None:
    check(fuzzed, topic, FEW, 0)


@pytest.mark.slow
@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_many_random_messages_are_survived(fuzzed: tuple[Bench, Taken], topic: Topic) -> None:
    """As many as the environment variable DYFN_FUZZ says."""
    check(fuzzed, topic, MANY, 1)


def test_every_topic_that_the_node_subscribes_is_among_them(fuzzed: tuple[Bench, Taken]) -> None:
    bench, _ = fuzzed
    subscribed = {one.topic_name for one in bench.node.subscriptions}
    kinds = {topic.name.rpartition("/")[2] for topic in TOPICS}
    assert {name.rpartition("/")[2] for name in subscribed} == kinds
    assert {topic.name for topic in TOPICS} <= subscribed
