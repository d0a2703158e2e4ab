"""Which messages a full queue drops."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from symbid_ros.bags import QueuedMessage
from symbid_ros.bags.writing.background import MessageQueue

SENSOR, CAMERA = 0, 1


def message(topic: int, number: int, size: int) -> QueuedMessage:
    return QueuedMessage(topic, number, number, bytes(size))


def numbers(messages: list[QueuedMessage], topic: int) -> list[int]:
    return [each.log_time for each in messages if each.topic == topic]


def test_camera_displaces_no_sensor_messages() -> None:
    """33 samples of 300 B for each image of 5 MB, and a writer that takes a third of the bytes."""
    queue = MessageQueue(capacity=50_000_000)
    taken: list[QueuedMessage] = []
    for number in range(3000):
        queue.put(message(SENSOR, number, 300))
        if number % 33 == 0:
            queue.put(message(CAMERA, number, 5_000_000))
        if number % 100 == 0:
            taken += queue.take(1)
            taken += queue.take(65536)
        assert queue.size <= 50_000_000
    taken += queue.take(10**9)
    assert numbers(taken, SENSOR) == list(range(3000))
    images = numbers(taken, CAMERA)
    assert images == sorted(images)
    assert queue.dropped == {CAMERA: 91 - len(images)}
    assert 0 < len(images) < 91
    assert queue.size == 0


@given(
    st.lists(
        st.one_of(
            st.tuples(st.integers(0, 3), st.integers(0, 60)),  # put: topic and size
            st.integers(0, 150),  # take: bytes
        ),
        max_size=80,
    )
)
def test_queue_equals_a_list_that_drops_from_the_largest_topic(
    operations: list[tuple[int, int] | int],
) -> None:
    queue = MessageQueue(capacity=100)
    kept: list[QueuedMessage] = []
    dropped: Counter[int] = Counter()
    for number, operation in enumerate(operations):
        if isinstance(operation, int):
            expected: list[QueuedMessage] = []
            while kept and sum(len(each.payload) for each in expected) < operation:
                expected.append(kept.pop(0))
            assert queue.take(operation) == expected
            continue
        new = message(operation[0], number, operation[1])
        queue.put(new)
        kept.append(new)
        while len(kept) > 1 and sum(len(each.payload) for each in kept) > 100:
            sizes = Counter()
            for each in kept:
                sizes[each.topic] += len(each.payload)
            # Of equally large topics any may lose.
            losers = {t for t, size in sizes.items() if size == max(sizes.values())}
            loser = next(t for t in losers if queue.dropped.get(t, 0) > dropped[t])
            last = max(n for n, each in enumerate(kept) if each.topic == loser)
            dropped[loser] += 1
            del kept[last]
    assert queue.size == sum(len(each.payload) for each in kept)
    assert queue.take(10**6) == kept
    assert queue.dropped == dropped
