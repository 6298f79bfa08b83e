"""rclpy.spin and its sisters: futures, time limits, shutdown from a callback, exceptions, guard conditions."""

import rclpy
from conformance import attempt, log
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future


def futures() -> None:
    rclpy.init(args=[])
    node = rclpy.create_node("futures")
    future = Future()
    rclpy.spin_until_future_complete(node, future, timeout_sec=0.05)
    log("time limit", done=future.done())
    calls: list[int] = []

    def on_timer() -> None:
        calls.append(len(calls))
        if len(calls) == 3:
            future.set_result("third")

    timer = node.create_timer(0.01, on_timer)
    rclpy.spin_until_future_complete(node, future, timeout_sec=5.0)
    log("future", done=future.done(), result=future.result(), calls=calls)
    rclpy.spin_once(node, timeout_sec=1.0)
    log("spin_once", calls=calls)
    timer.cancel()
    done = Future()
    done.set_result(1)
    rclpy.spin_until_future_complete(node, done)
    log("already done", result=done.result())

    failed = Future()
    failed.set_exception(ValueError("no"))
    log("exception", done=failed.done(), kind=type(failed.exception()))
    attempt("result of it", failed.result)
    canceled = Future()
    canceled.cancel()
    log("cancel", done=canceled.done(), canceled=canceled.cancelled(), result=canceled.result())
    rclpy.shutdown()


def shut_down_by_callback() -> None:
    rclpy.init(args=[])
    node = Node("ender")
    ticks: list[int] = []

    def on_timer() -> None:
        ticks.append(len(ticks))
        if len(ticks) == 3:
            rclpy.shutdown()

    node.create_timer(0.01, on_timer)
    try:
        rclpy.spin(node)
        how = "returned"
    except ExternalShutdownException:
        how = "ExternalShutdownException"
    log("shutdown in a callback", ticks=ticks, how=how, ok=rclpy.ok())
    rclpy.try_shutdown()


def exception_in_callback() -> None:
    rclpy.init(args=[])
    node = Node("raiser")
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    class PlannedError(Exception):
        pass

    def on_timer() -> None:
        timer.cancel()
        raise PlannedError("on purpose")

    timer = node.create_timer(0.01, on_timer)
    attempt("exception in a callback", executor.spin)
    later: list[int] = []

    def on_later() -> None:
        later.append(1)
        after.cancel()

    after = node.create_timer(0.01, on_later)
    executor.spin_once(timeout_sec=1.0)
    log("goes on", later=later)
    rclpy.shutdown()


def guard() -> None:
    rclpy.init(args=[])
    node = Node("guarded")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    calls: list[int] = []
    condition = node.create_guard_condition(lambda: calls.append(1))
    executor.spin_once(timeout_sec=0.05)
    log("guard before", calls=len(calls))
    condition.trigger()
    executor.spin_once(timeout_sec=1.0)
    executor.spin_once(timeout_sec=0.05)
    log("guard", calls=len(calls), destroyed=node.destroy_guard_condition(condition))
    rclpy.shutdown()


def main() -> None:
    futures()
    shut_down_by_callback()
    exception_in_callback()
    guard()


if __name__ == "__main__":
    main()
