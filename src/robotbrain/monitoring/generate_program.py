"""A generated pipeline as a program of nodes, and its run."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.monitoring.trace import Recorder, Trace, stamp_of

if TYPE_CHECKING:
    from robotbrain.monitoring.generate import NodePlan, Pipeline, Task
    from robotbrain.ros import SimContext


def draw_factor(key: tuple[int, ...], sigma: float) -> float:
    """Return a log-normal factor of mean 1 that depends on ``key`` alone."""
    return float(np.exp(sigma * np.random.default_rng(key).standard_normal() - sigma * sigma / 2)) if sigma else 1.0


def run_pipeline(pipeline: Pipeline, seconds: float, day: int) -> Trace:
    """Run a pipeline for so many simulated seconds and return the trace."""
    from robotbrain.ros import DeviceResources, SimContext
    from robotbrain.ros.executors import Executor

    def latency(_: str, size: int) -> int:
        return round(pipeline.latency_ms * 1e6 + pipeline.byte_ns * size)

    device = DeviceResources(cpu_cores=pipeline.cores, gpu=pipeline.gpu, dla=pipeline.dla)
    context = SimContext(latency_ns=latency, resources=device)
    context.log_sink = lambda _: None
    recorder = Recorder(context, title=f"generated pipeline {pipeline.seed}: {pipeline.fault}")
    with context.as_default():
        _Robot(pipeline, context, day)
        executors: dict[int, Executor] = {}
        for plan in pipeline.nodes:
            if plan.executor not in executors:
                threads = pipeline.threads.get(plan.executor, 1)
                executors[plan.executor] = Executor(context=context, num_threads=threads)
            chosen = executors[plan.executor]
            context.default_executor_factory = lambda _, chosen=chosen: chosen  # type: ignore[misc]
            _Program(pipeline, plan, context, day)
        context.run_for(seconds)
    return recorder.trace()


def _image(stamp_ns: int, size: int) -> Any:
    from sensor_msgs.msg import CompressedImage

    from robotbrain.ros.conversions import ns_to_time

    message = CompressedImage()
    message.header.stamp = ns_to_time(stamp_ns)
    message.data = np.zeros(max(0, size - 40), dtype=np.uint8)
    return message


def _Robot(pipeline: Pipeline, context: SimContext, day: int) -> None:  # noqa: N802 - makes the robot's node
    """Make the node that publishes the sensors and takes commands; it runs on hardware of its own."""
    from geometry_msgs.msg import Twist
    from rclpy.node import Node
    from sensor_msgs.msg import CompressedImage

    node = Node("robot", context=context)
    node.create_subscription(Twist, "cmd_vel", lambda _: None, 10)
    for number, sensor in enumerate(pipeline.sensors):
        publisher = node.create_publisher(CompressedImage, sensor.topic, 10)

        def publish(sensor: Any = sensor, publisher: Any = publisher, number: int = number) -> None:
            now = context.now_ns
            factor = draw_factor((pipeline.seed, day, 7, number, now), sensor.size_sigma)
            publisher.publish(_image(now, round(sensor.size * factor)))

        publish.__name__ = "read" + sensor.topic.replace("/", "_")

        def start(_: object, sensor: Any = sensor, publish: Any = publish) -> None:
            node.create_timer(sensor.period_ms * 1e-3, publish)

        context.schedule(round(sensor.phase_ms * 1e6), start)


class _Program:
    """One node of a pipeline at work."""

    def __init__(self, pipeline: Pipeline, plan: NodePlan, context: SimContext, day: int) -> None:
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.node import Node

        self._pipeline, self._plan, self._context, self._day = pipeline, plan, context, day
        self._node = Node(plan.name.strip("/"), context=context)
        self._stamp = 0
        self._pending = False
        self._publishers: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}
        self._answers = {task.name: task for task in plan.tasks if task.kind == "client"}
        parallel = pipeline.threads.get(plan.executor, 1) > 1 and not any(t.publishes for t in plan.tasks)
        self._group = ReentrantCallbackGroup() if parallel else None
        for task in plan.tasks:
            self._create(task)

    def _create(self, task: Task) -> None:
        from geometry_msgs.msg import Twist
        from nav_msgs.srv import GetPlan
        from rclpy.qos import HistoryPolicy, QoSProfile
        from sensor_msgs.msg import CompressedImage

        node, context = self._node, self._context
        for topic, _ in task.publishes:
            kind = Twist if topic == "/cmd_vel" else CompressedImage
            self._publishers.setdefault(topic, node.create_publisher(kind, topic, 10))
        if task.calls:
            self._clients[task.calls] = node.create_client(GetPlan, task.calls)
        if task.kind == "subscription":
            depth = task.depth
            qos = QoSProfile(history=HistoryPolicy.KEEP_ALL) if depth is None else QoSProfile(depth=depth)
            node.create_subscription(
                CompressedImage, task.name, lambda data: self._on_message(task, data), qos, raw=True
            )
        elif task.kind == "timer":

            def fire() -> None:
                self._run(task, context.now_ns, 0)

            fire.__name__ = task.name
            context.schedule(round(task.phase_ms * 1e6), lambda _: self._start(task.period_ms * 1e-3, fire))
        elif task.kind == "service":
            node.create_service(GetPlan, task.name, lambda request, response: self._serve(task, request, response))

    def _start(self, seconds: float, fire: Any) -> None:
        self._node.create_timer(seconds, fire, self._group)

    def _on_message(self, task: Task, data: bytes) -> None:
        self._stamp = stamp_of(data)
        self._run(task, self._stamp, len(data))

    def _serve(self, task: Task, request: Any, response: Any) -> Any:
        from robotbrain.ros.conversions import time_to_ns

        stamp = request.start.header.stamp
        self._run(task, time_to_ns(stamp), 0)
        response.plan.header.stamp = stamp
        return response

    def _run(self, task: Task, key: int, size: int) -> None:
        context, pipeline = self._context, self._pipeline
        for number, work in enumerate(task.work):
            name = zlib.crc32(f"{self._plan.name} {task.kind} {task.name} {number}".encode())
            drawn = work.mean_ms * 1e6 * draw_factor((pipeline.seed, self._day, name, key), work.sigma)
            cost = (drawn + work.byte_ns * size) / pipeline.speed.get(work.resource, 1.0)
            context.charge(max(1, round(cost)), work.resource)
        for topic, length in task.publishes:
            self._publish(topic, length, key if task.kind != "timer" else self._stamp)
        if task.calls and not self._pending:
            self._call(task.calls, key)

    def _publish(self, topic: str, size: int, stamp_ns: int) -> None:
        from geometry_msgs.msg import Twist

        self._publishers[topic].publish(Twist() if topic == "/cmd_vel" else _image(stamp_ns, size))

    def _call(self, service: str, stamp_ns: int) -> None:
        from nav_msgs.srv import GetPlan

        from robotbrain.ros.conversions import ns_to_time

        request = GetPlan.Request()
        request.start.header.stamp = ns_to_time(stamp_ns)
        self._pending = True
        future = self._clients[service].call_async(request)

        def answered(_: Any) -> None:
            self._pending = False
            task = self._answers.get(service)
            if task is not None:
                self._run(task, stamp_ns, 0)

        future.add_done_callback(answered)
