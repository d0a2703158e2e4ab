"""Messages that arrive while an estimate is computed are kept."""

from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from std_msgs.msg import String

from symbid_ros.messages.topics import Topic
from symbid_ros.ros.raw_subscription import MessageReceiver, PolledGroup, subscribe

DEPTH = 5
BEST_EFFORT = QoSProfile(depth=DEPTH, reliability=QoSReliabilityPolicy.BEST_EFFORT)


def test_more_messages_than_the_queue_holds_wait_for_a_slow_reader(graph) -> None:
    publisher = graph.node.create_publisher(String, "words", BEST_EFFORT)
    graph.wait_until(lambda: graph.node.count_publishers("/words"))
    queue = subscribe(graph.node, "/words", DEPTH, PolledGroup())
    assert queue is not None
    receiver = MessageReceiver()
    receiver.subscribe([(Topic("/words", queue.msgtype), queue)])
    graph.wait_until(publisher.get_subscription_count)

    def waiting() -> int:
        return sum(len(batch.messages) for batch in receiver._waiting)

    sent = 4 * DEPTH
    with receiver:
        for number in range(sent):
            publisher.publish(String(data=f"{number:04}"))
            if number % DEPTH == DEPTH - 1:  # nobody reads, yet the queue is emptied
                graph.wait_until(lambda expected=number + 1: waiting() == expected)
    words, batch = [], receiver.take()
    while batch.messages:
        words += [bytes(message.payload)[8:12].decode() for _, message in batch.messages]
        batch = receiver.take()
    assert words == [f"{number:04}" for number in range(sent)]
