"""Queues the work of a node's services for its main thread, and awaits the answers."""

from collections.abc import Callable
from queue import SimpleQueue
from threading import Event

from std_srvs.srv import Trigger

from symbid_ros.errors import SymbidError

ANSWER_POLL = 0.1  # s

Answer = tuple[bool, str]
TriggerHandler = Callable[[Trigger.Request, Trigger.Response], Trigger.Response]


class _Request:
    """Queued work and its answer."""

    def __init__(self, work: Callable[[], str]) -> None:
        self._work, self._done = work, Event()
        self._answer: Answer = (False, "the identifier is shutting down")

    def perform(self) -> None:
        try:
            self._answer = (True, self._work())
        except (SymbidError, OSError) as error:
            self._answer = (False, str(error))
        self._done.set()

    def await_answer(self, ended: Event) -> Answer:
        # A request that arrives during shutdown is never performed.
        while not self._done.wait(ANSWER_POLL) and not ended.is_set():
            pass
        return self._answer


class ServiceRequests:
    """Requests of services, which the main thread performs one after the other.

    Attributes
    ----------
    ended : Event
        Set when the main thread performs no further request.
    """

    def __init__(self) -> None:
        self._queue: SimpleQueue[_Request] = SimpleQueue()
        self.ended = Event()

    def put(self, work: Callable[[], str]) -> _Request:
        """Queue work that returns an answer as text, or raises an error."""
        request = _Request(work)
        self._queue.put(request)
        return request

    def handler(self, work: Callable[[], str]) -> TriggerHandler:
        """Return a service callback that queues work and waits for its answer."""

        def handle(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = self.put(work).await_answer(self.ended)
            return response

        return handle

    def perform(self) -> None:
        """Perform all queued requests."""
        while not self._queue.empty():
            self._queue.get().perform()
