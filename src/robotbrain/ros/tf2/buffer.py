"""``tf2_ros.buffer``: the buffer a program looks transforms up in.

What differs from genuine tf2_ros, because time is simulated: a lookup with a timeout *outside* callbacks lets the
simulation run until the transform is there or the time is over. *Inside* a callback nothing can arrive before the
callback returns, so the lookup fails at once, with the exception genuine tf2 raises after the timeout, and advice.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from robotbrain.ros.context import SimContext
from robotbrain.ros.conversions import msg_class
from robotbrain.ros.logging import LoggingSeverity
from robotbrain.ros.task import Future
from robotbrain.ros.tf2.buffer_interface import BufferInterface
from robotbrain.ros.tf2.core import BufferCore, to_ns
from robotbrain.ros.tf2.exceptions import TransformException
from robotbrain.ros.time import Duration

__all__ = ["Buffer"]

_FRAME_GRAPH = "tf2_msgs/srv/FrameGraph"
_ADVICE = (
    "; the timeout was not waited for: inside a callback no transform can arrive before the callback returns. "
    "Ask for Time() (the latest), try again in the next callback, or await buffer.lookup_transform_async(...)"
)


class Buffer(BufferCore, BufferInterface):
    """Frames, their history, and lookups that can wait.

    Args:
        cache_time: how far the history reaches back; 10 s when omitted.
        node: whose clock is watched for jumps back in time, and which offers the ``tf2_frames`` service.
    """

    def __init__(self, cache_time: Duration | None = None, node: Any = None) -> None:
        BufferCore.__init__(self, cache_time)
        BufferInterface.__init__(self)
        self._node = node
        self._waiting: list[Callable[[], None]] = []
        self._clock: Any = node.get_clock() if node is not None else None
        self._newest_ns = 0
        if node is not None:
            self.srv = node.create_service(msg_class(_FRAME_GRAPH), "tf2_frames", self._get_frames)

    def _get_frames(self, request: Any, response: Any) -> Any:
        response.frame_yaml = self.all_frames_as_yaml()
        return response

    # ------------------------------------------------------------ input

    def set_transform(self, transform: Any, authority: str) -> None:
        """Add a transform; see :meth:`BufferCore.set_transform`. Who waits for it is told."""
        self._watch_clock()
        super().set_transform(transform, authority)
        self._tell()

    def set_transform_static(self, transform: Any, authority: str) -> None:
        """Add a static transform. Who waits for it is told."""
        self._watch_clock()
        super().set_transform_static(transform, authority)
        self._tell()

    def _watch_clock(self) -> None:
        if self._clock is None:
            return
        now_ns = int(self._clock.now().nanoseconds)
        if now_ns < self._newest_ns:
            self.time_jump_callback(None)
        self._newest_ns = now_ns

    def time_jump_callback(self, time_jump: Any) -> None:
        """Forget the history: time jumped back (a replay began again), so it would be taken for the future."""
        self._log(LoggingSeverity.WARN, "Detected jump back in time. Clearing tf buffer.")
        self.clear()

    def _tell(self) -> None:
        for callback in list(self._waiting):
            callback()

    # ------------------------------------------------------------ lookups

    def lookup_transform(self, target_frame: str, source_frame: str, time: Any, timeout: Duration = Duration()) -> Any:  # noqa: B008 - as tf2
        """Return the ``TransformStamped`` that takes coordinates of ``source_frame`` to ``target_frame``.

        Args:
            target_frame: frame of the result's header.
            source_frame: the result's child frame.
            time: ``rclpy.time.Time`` or a header's stamp; ``Time()`` for the latest common time.
            timeout: how long to wait for it; see the head of this module.

        Raises:
            LookupException, ConnectivityException, ExtrapolationException, InvalidArgumentException: as
                :meth:`BufferCore.lookup_transform_core`.
        """
        waited = self._wait(lambda: self.can_transform_core(target_frame, source_frame, time)[0], timeout)
        return self._with_advice(waited, lambda: self.lookup_transform_core(target_frame, source_frame, time))

    def lookup_transform_full(
        self,
        target_frame: str,
        target_time: Any,
        source_frame: str,
        source_time: Any,
        fixed_frame: str,
        timeout: Duration = Duration(),  # noqa: B008 - as tf2
    ) -> Any:
        """Return the transform from the source frame at one time to the target frame at another.

        ``fixed_frame`` is taken not to have moved in between. Otherwise as :meth:`lookup_transform`.
        """
        query = (target_frame, target_time, source_frame, source_time, fixed_frame)
        waited = self._wait(lambda: self.can_transform_full_core(*query)[0], timeout)
        return self._with_advice(waited, lambda: self.lookup_transform_full_core(*query))

    def can_transform(
        self,
        target_frame: str,
        source_frame: str,
        time: Any,
        timeout: Duration = Duration(),  # noqa: B008 - as tf2
        return_debug_tuple: bool = False,
    ) -> Any:
        """Tell whether :meth:`lookup_transform` would succeed within ``timeout``.

        Returns:
            A bool, or with ``return_debug_tuple`` a bool and the reason why not.
        """
        waited = self._wait(lambda: self.can_transform_core(target_frame, source_frame, time)[0], timeout)
        return self._answer(waited, self.can_transform_core(target_frame, source_frame, time), return_debug_tuple)

    def can_transform_full(
        self,
        target_frame: str,
        target_time: Any,
        source_frame: str,
        source_time: Any,
        fixed_frame: str,
        timeout: Duration = Duration(),  # noqa: B008 - as tf2
        return_debug_tuple: bool = False,
    ) -> Any:
        """Tell whether :meth:`lookup_transform_full` would succeed within ``timeout``."""
        query = (target_frame, target_time, source_frame, source_time, fixed_frame)
        waited = self._wait(lambda: self.can_transform_full_core(*query)[0], timeout)
        return self._answer(waited, self.can_transform_full_core(*query), return_debug_tuple)

    # ------------------------------------------------------------ asynchronous

    def wait_for_transform_async(self, target_frame: str, source_frame: str, time: Any) -> Future:
        """Return a future that gets the transform as soon as it is possible."""
        return self._when(
            lambda: self.can_transform_core(target_frame, source_frame, time)[0],
            lambda: self.lookup_transform_core(target_frame, source_frame, time),
        )

    def wait_for_transform_full_async(
        self, target_frame: str, target_time: Any, source_frame: str, source_time: Any, fixed_frame: str
    ) -> Future:
        """Return a future that gets the transform of :meth:`lookup_transform_full` as soon as it is possible."""
        query = (target_frame, target_time, source_frame, source_time, fixed_frame)
        return self._when(
            lambda: self.can_transform_full_core(*query)[0], lambda: self.lookup_transform_full_core(*query)
        )

    async def lookup_transform_async(self, target_frame: str, source_frame: str, time: Any) -> Any:
        """Wait for the transform and return it; for ``async def`` callbacks."""
        await self.wait_for_transform_async(target_frame, source_frame, time)
        return self.lookup_transform_core(target_frame, source_frame, time)

    async def lookup_transform_full_async(
        self, target_frame: str, target_time: Any, source_frame: str, source_time: Any, fixed_frame: str
    ) -> Any:
        """Wait for the transform of :meth:`lookup_transform_full` and return it."""
        query = (target_frame, target_time, source_frame, source_time, fixed_frame)
        await self.wait_for_transform_full_async(*query)
        return self.lookup_transform_full_core(*query)

    def _when(self, ready: Callable[[], bool], look_up: Callable[[], Any]) -> Future:
        future = Future()
        if ready():
            future.set_result(look_up())
            return future

        def on_new_data() -> None:
            if not future.done() and ready():
                future.set_result(look_up())

        self._waiting.append(on_new_data)
        future.add_done_callback(lambda _: self._waiting.remove(on_new_data))
        return future

    # ------------------------------------------------------------ waiting

    def _context(self) -> SimContext | None:
        context = getattr(self._node, "context", None)
        return context if isinstance(context, SimContext) else super()._context()

    def _wait(self, ready: Callable[[], bool], timeout: Any) -> bool:
        """Let the simulation run until ``ready()``; return False when it may not run here although it should."""
        timeout_ns = to_ns(timeout)
        context = self._context()
        if timeout_ns <= 0 or context is None or ready():
            return True
        if context.running is not None:
            return False
        deadline = context.now_ns + timeout_ns
        if context.horizon_ns is not None:
            deadline = max(context.now_ns, min(deadline, context.horizon_ns))
        while context.ok() and not ready():
            upcoming = context.next_event_ns()
            if upcoming is None or upcoming > deadline:
                context.run_until(deadline)
                break
            context.step()
        return True

    def _with_advice(self, waited: bool, look_up: Callable[[], Any]) -> Any:
        try:
            return look_up()
        except TransformException as error:
            if waited:
                raise
            raise type(error)(f"{error}{_ADVICE}") from None

    def _answer(self, waited: bool, found: tuple[bool, str], with_reason: bool) -> Any:
        if not waited and not found[0]:
            found = (False, found[1] + _ADVICE)
        return found if with_reason else found[0]
