"""A node on simulated time: what its clock reads, before and after time moves, and jumps."""

from conformance import SimulatedTime, executor_of, log, ros, sim_node
from rclpy.clock import ClockChange, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration


def main() -> None:
    node = sim_node("node")
    executor = executor_of(node)
    log("parameter", use_sim_time=node.get_parameter("use_sim_time").value)
    time = SimulatedTime(executor, node)
    clock = node.get_clock()
    log("clock", kind=clock.clock_type, active=clock.ros_time_is_active, now=clock.now().nanoseconds)
    time.jump(0.5)
    log("moved", now=clock.now().nanoseconds, stamp=clock.now().to_msg(), again=clock.now() == clock.now())
    log("kind of now", kind=clock.now().clock_type, is_ros=clock.now().clock_type == ClockType.ROS_TIME)
    elapsed = clock.now()
    time.advance(0.3, 0.1)
    log("elapsed", nanoseconds=(clock.now() - elapsed).nanoseconds)

    jumps: list[tuple[str, int]] = []
    handle = clock.create_jump_callback(
        JumpThreshold(min_forward=Duration(seconds=0.2), min_backward=None, on_clock_change=False),
        pre_callback=lambda: jumps.append(("before", clock.now().nanoseconds)),
        post_callback=lambda jump: jumps.append((jump.clock_change.name, jump.delta.nanoseconds)),
    )
    time.jump(0.1)
    log("small step", jumps=jumps)
    time.jump(1.0)
    log("jump", jumps=jumps, no_change=[name for name, _ in jumps[1:]] == [ClockChange.ROS_TIME_NO_CHANGE.name])
    handle.unregister()
    time.jump(1.0)
    log("unregistered", count=len(jumps))


if __name__ == "__main__":
    with ros():
        main()
