"""Timers on simulated time: periods, cancel, reset, autostart, a jump over many periods, another clock."""

from conformance import SimulatedTime, attempt, executor_of, log, ros, sim_node, spin_until, steady
from rclpy.duration import Duration
from rclpy.node import Node


def main() -> None:
    node = sim_node("node")
    executor = executor_of(node)
    time = SimulatedTime(executor, node)
    calls: list[tuple[str, int]] = []

    def note(name: str):
        return lambda: calls.append((name, (node.get_clock().now().nanoseconds - start) // 1_000_000))

    start = node.get_clock().now().nanoseconds
    fast = node.create_timer(0.1, note("fast"))
    slow = node.create_timer(0.25, note("slow"))
    time.advance(0.5, 0.05)
    log("two periods", calls=sorted(calls, key=lambda call: (call[1], call[0])))
    log("period", fast=fast.timer_period_ns, slow=slow.timer_period_ns)
    node.destroy_timer(slow)

    calls.clear()
    fast.cancel()
    time.advance(0.3, 0.05)
    log("canceled", calls=calls, canceled=fast.is_canceled(), until_next=fast.time_until_next_call())
    fast.reset()
    log("reset", canceled=fast.is_canceled(), until_next=fast.time_until_next_call())
    time.advance(0.2, 0.05)
    log("after reset", calls=calls)

    # Reset in the middle of a period starts a new one.
    calls.clear()
    time.advance(0.05, 0.05)
    fast.reset()
    time.advance(0.15, 0.05)
    log("reset between", calls=calls)

    # A jump over several periods gives one call, and the grid of the timer goes on.
    fast.reset()
    calls.clear()
    time.jump(0.37)
    log("jump", calls=calls, until_next=fast.time_until_next_call(), since_last=fast.time_since_last_call())
    time.advance(0.2, 0.01)
    log("after the jump", calls=calls)
    node.destroy_timer(fast)

    calls.clear()
    late = node.create_timer(0.1, note("late"), autostart=False)
    time.advance(0.3, 0.1)
    log("no autostart", calls=calls, canceled=late.is_canceled())
    late.reset()
    time.advance(0.2, 0.1)
    log("started", calls=calls)
    node.destroy_timer(late)

    # A callback that cancels its own timer is not called again; one that resets it goes on.
    calls.clear()
    once = node.create_timer(0.1, lambda: (note("once")(), once.cancel()))
    time.advance(0.4, 0.1)
    log("once", calls=calls)
    node.destroy_timer(once)

    calls.clear()
    changed = node.create_timer(0.1, note("changed"))
    time.advance(0.2, 0.1)
    changed.timer_period_ns = 200_000_000
    time.advance(0.6, 0.1)
    log("changed period", calls=calls, period=changed.timer_period_ns)
    node.destroy_timer(changed)

    attempt("zero period", lambda: node.create_timer(0.0, lambda: None) and None)
    attempt("negative period", lambda: node.create_timer(-1.0, lambda: None) and None)
    attempt("period that is text", lambda: node.create_timer("fast", lambda: None) and None)
    timer = node.create_timer(0.1, lambda: None)
    log("timers", there=timer in list(node.timers))
    log("destroyed", result=node.destroy_timer(timer), there=timer in list(node.timers))
    log("destroyed twice", result=node.destroy_timer(timer))

    # A node without simulated time has another clock. Calls missed while its callback was busy become one.
    other = Node("other")
    executor.add_node(other)
    clock = steady()
    begin = clock.now()
    ticks: list[float] = []

    def on_tick() -> None:
        ticks.append(round((clock.now() - begin).nanoseconds / 200_000_000))
        if len(ticks) == 1:
            clock.sleep_for(Duration(seconds=0.66))

    ticker = other.create_timer(0.2, on_tick)
    assert spin_until(executor, lambda: len(ticks) == 4)
    ticker.cancel()
    log("missed calls", periods=ticks)


if __name__ == "__main__":
    with ros():
        main()
