"""Services and clients (``rclpy.service``, ``rclpy.client``)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.ros import cdr
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.entity import Entity
from robotbrain.ros.exceptions import ReentrancyError, SimulationDeadlockError, TypeConflictError
from robotbrain.ros.executors import Work
from robotbrain.ros.qos import QoSProfile
from robotbrain.ros.spinning import spin_while
from robotbrain.ros.task import Future

if TYPE_CHECKING:
    from robotbrain.ros.node import Node

_MAX_FAILED_WAITS = 100

Request = tuple["Client", bytes, Future]
"""A request on its way: who asks, CDR, and where the response goes."""


class Patience:
    """Waits for a server without waiting forever for what cannot come."""

    def __init__(self, node: Node) -> None:
        self._node, self._failed = node, 0

    def wait(self, ready: Callable[[], bool], timeout_sec: float | None, what: str, never: Callable[[], str]) -> bool:
        """Return whether ``ready()``, letting simulated time pass until it is; inside a callback answer at once.

        Raises:
            SimulationDeadlockError: with ``never()`` as its text: waited without limit, or 100 times in vain.
        """
        if not ready() and not self._node.context.in_callback():
            try:
                spin_while(self._node.context, lambda: not ready(), timeout_sec, what)
            except SimulationDeadlockError:
                raise SimulationDeadlockError(never()) from None
        if ready():
            self._failed = 0
            return True
        self._failed += 1
        if self._failed >= _MAX_FAILED_WAITS:
            raise SimulationDeadlockError(never())
        return False


class ServiceTypeError(InputError, RuntimeError):
    """Something else than a service class was given (genuine rclpy raises RuntimeError)."""


def srv_name_of(srv_type: Any) -> str:
    """Return the ROS name of a service class; raise InputError when it is none."""
    name = getattr(srv_type, "__srvtype__", None)
    if not isinstance(name, str):
        raise ServiceTypeError(
            "service type",
            given=srv_type,
            expected="a service class such as std_srvs.srv.Trigger",
            fix="Pass the class itself: from std_srvs.srv import Trigger.",
        )
    return name


class Service(Entity):
    """Answers requests: ``callback(request, response) -> response``, plain or ``async def``."""

    kind = "service"

    def __init__(
        self,
        node: Node,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        qos: QoSProfile,
        group: CallbackGroup | None = None,
    ) -> None:
        super().__init__(node, srv_name, callback, group)
        self.srv_type, self.srv_name, self.qos_profile = srv_type, srv_name, qos
        self.typename = srv_name_of(srv_type)
        self._queue: deque[Work] = deque()
        known = node.context.services.get(srv_name)
        if known is not None:
            raise TypeConflictError(
                f"service {srv_name}",
                given=f"a second server, in {node.get_fully_qualified_name()}",
                expected=f"one server; {known.node.get_fully_qualified_name()} has it",
                fix="Give it another name or destroy the first.",
            )
        node.context.services[srv_name] = self

    @property
    def service_name(self) -> str:
        """Absolute service name."""
        return self.srv_name

    def receive(self, request: Request, message_id: int) -> None:
        """Queue a request that has arrived; a full queue loses its oldest, whose future never completes."""
        work = Work(self, request, self.node.context.now_ns, message_id)
        limit = self.qos_profile.queue_limit
        if limit is not None and len(self._queue) >= limit:
            lost = self._queue.popleft()
            lost.alive = False
            self.node.get_logger().warning(
                f"service {self.srv_name}: queue of {limit} requests is full; the oldest, from "
                f"{lost.payload[0].node.get_fully_qualified_name()}, is lost"
            )
        self._queue.append(work)
        self.node._enqueue(work)

    def execute(self, work: Work) -> Any:
        """Decode the request and call back."""
        self._queue.remove(work)
        assert self.callback is not None
        return self.callback(cdr.from_cdr(work.payload[1], self.srv_type.Request), self.srv_type.Response())

    def complete(self, work: Work, result: Any) -> None:
        """Send the response that the callback returned."""
        self.send_response(result, work.payload)

    def send_response(self, response: Any, header: Request) -> None:
        """Answer a request.

        Args:
            response: a Response of this service.
            header: which request it answers.

        Raises:
            TypeError: not a response of this service.
        """
        if not isinstance(response, self.srv_type.Response):
            raise TypeError(
                f"the callback of service {self.srv_name} returned {type(response).__name__}; it must return the "
                f"{self.typename} Response it was given (is 'return response' missing?)"
            )
        client, _, future = header
        context = self.node.context
        context.release(client.deliver, (cdr.to_cdr(response), future, context.new_message_id(), self.node))

    def destroy(self) -> None:
        """Stop serving."""
        if not self.destroyed:
            self.node.context.services.pop(self.srv_name, None)
            for work in self._queue:
                work.alive = False
            super().destroy()


class DeferredService(Service):
    """A service whose callback does not return the response: ``callback(request, header)`` sees to it that
    :meth:`Service.send_response` is called with that header, sooner or later."""

    def execute(self, work: Work) -> Any:
        """Decode the request and call back."""
        self._queue.remove(work)
        assert self.callback is not None
        return self.callback(cdr.from_cdr(work.payload[1], self.srv_type.Request), work.payload)

    def complete(self, work: Work, result: Any) -> None:
        """Do nothing: the response comes by itself."""


class Client(Entity):
    """Calls a service."""

    kind = "client"

    def __init__(
        self, node: Node, srv_type: Any, srv_name: str, qos: QoSProfile, group: CallbackGroup | None = None
    ) -> None:
        super().__init__(node, srv_name, None, group)
        self.srv_type, self.srv_name, self.qos_profile = srv_type, srv_name, qos
        self.typename = srv_name_of(srv_type)
        self._patience = Patience(node)
        self._removed: list[Future] = []

    @property
    def service_name(self) -> str:
        """Absolute service name."""
        return self.srv_name

    @property
    def callback_name(self) -> str:
        """Readable name for error messages."""
        return f"done callback of {self.srv_name}"

    def call_async(self, request: Any) -> Future:
        """Send a request; the future completes when the response has come back.

        Raises:
            TypeError: not a request of this service.
            TypeConflictError: the server has another type.
        """
        self.check_usable()
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(
                f"call of {self.srv_name}: expected a {self.typename} Request, got {type(request).__name__}"
                f"; build it with {self.srv_type.__name__}.Request()"
            )
        future = Future()
        future.completed_in = self.callback_group
        context = self.node.context
        context.release(self._send, (cdr.to_cdr(request), future, context.new_message_id()))
        return future

    def _send(self, call: tuple[bytes, Future, int]) -> None:
        context = self.node.context
        if context.message_taps:
            context.announce(call[2], "request", self.srv_name, self.typename, self.node, call[0])
        delay = context.transport_ns(self.srv_name, len(call[0]))
        context.schedule(context.now_ns + delay, self._arrive, call)

    def _arrive(self, call: tuple[bytes, Future, int]) -> None:
        server = self._server()
        if server is None:
            self.node.get_logger().warning(
                f"request to {self.srv_name} is lost: no node offers this service. {self._offers()}"
            )
            return
        data, future, message_id = call
        server.receive((self, data, future), message_id)

    def deliver(self, answer: tuple[bytes, Future, int, Node]) -> None:
        """Take a response on its way back."""
        context = self.node.context
        if context.message_taps:
            context.announce(answer[2], "response", self.srv_name, self.typename, answer[3], answer[0])
        delay = context.transport_ns(self.srv_name, len(answer[0]))
        context.schedule(context.now_ns + delay, self._receive, answer)

    def _receive(self, answer: tuple[bytes, Future, int, Node]) -> None:
        if not self.destroyed:
            self.node._enqueue(Work(self, answer[:2], self.node.context.now_ns, answer[2]))

    def execute(self, work: Work) -> Any:
        """Complete the future; its done callbacks run on this node's executor."""
        data, future = work.payload
        if future._pending() and future not in self._removed:
            future.set_result(cdr.from_cdr(data, self.srv_type.Response))

    def call(self, request: Any, timeout_sec: float | None = None) -> Any:
        """Call and wait, outside callbacks only.

        Raises:
            ReentrancyError: inside a callback. Genuine rclpy deadlocks there too, unless a MultiThreadedExecutor and
                another callback group leave a thread for the answer; the kit never has one.
            TimeoutError: no answer in time.
        """
        if self.node.context.in_callback():
            raise ReentrancyError(
                f"client.call({self.srv_name}) inside a callback waits for an answer that can only come after the "
                "callback returns (genuine rclpy deadlocks too, unless another thread and callback group are free; "
                "the kit runs callbacks one by one): use future = client.call_async(request) and "
                "future.add_done_callback(...), or 'await' it in an async def callback"
            )
        future = self.call_async(request)
        executor = self.node.executor
        if executor is None:
            raise SimulationDeadlockError(f"node {self.node.get_name()} has no executor to receive the answer")
        executor.spin_until_future_complete(future, timeout_sec)
        if not future.done():
            raise TimeoutError(f"service {self.srv_name} gave no answer within {timeout_sec} s")
        return future.result()

    def remove_pending_request(self, future: Future) -> None:
        """Forget a call: its future will not be completed."""
        self._removed.append(future)

    def _server(self) -> Service | None:
        server = self.node.context.services.get(self.srv_name)
        if server is not None and server.typename != self.typename:
            raise TypeConflictError(
                f"type of service {self.srv_name}",
                given=self.typename,
                expected=f"{server.typename}, as {server.node.get_fully_qualified_name()} serves it",
                fix="Create the client with that type.",
            )
        return server

    def service_is_ready(self) -> bool:
        """Tell whether a node offers the service."""
        return self._server() is not None

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        """Return whether the service is there, letting simulated time pass until it is.

        Inside a callback it answers at once: nothing else can happen before the callback returns.

        Raises:
            SimulationDeadlockError: waited without limit, or 100 times in vain.
        """
        return self._patience.wait(self.service_is_ready, timeout_sec, "wait_for_service", self._never)

    def _never(self) -> str:
        return (
            f"{self.node.get_fully_qualified_name()} waits in vain for service {self.srv_name} ({self.typename}): "
            f"create the node that serves it first, or check the name. {self._offers()}"
        )

    def _offers(self) -> str:
        return "Services offered: " + (", ".join(sorted(self.node.context.services)) or "none")
