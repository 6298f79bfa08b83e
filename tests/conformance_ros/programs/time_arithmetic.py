"""Times and durations: what adds up, compares, converts and rounds, and what raises."""

import operator

from builtin_interfaces.msg import Duration as DurationMessage
from builtin_interfaces.msg import Time as TimeMessage
from conformance import attempt, log, ros
from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration, Infinite
from rclpy.time import Time


def main() -> None:
    for seconds in (0, 1, 1.5, 0.1, 0.3, 1e-9, -0.25, 2.0000000019):
        log("duration", seconds=seconds, nanoseconds=Duration(seconds=seconds).nanoseconds)
    log("both", nanoseconds=Duration(seconds=1.5, nanoseconds=7).nanoseconds)
    attempt("duration too long", lambda: Duration(seconds=1e12))
    attempt("duration of text", lambda: Duration(seconds="1"))
    attempt("positional", lambda: Duration(1))
    for value in (Duration(seconds=2.5), Duration(nanoseconds=-1), Duration()):
        message = value.to_msg()
        log("duration message", sec=message.sec, nanosec=message.nanosec, back=Duration.from_msg(message) == value)
    log("infinite", nanoseconds=Infinite.nanoseconds)

    for seconds in (0, 1, 0.1, 12.3456789):
        time = Time(seconds=seconds)
        log("time", seconds=seconds, nanoseconds=time.nanoseconds, parts=time.seconds_nanoseconds())
    attempt("negative time", lambda: Time(seconds=-1))
    attempt("negative nanoseconds", lambda: Time(nanoseconds=-1))
    attempt("time too late", lambda: Time(seconds=1e12))
    log("defaults", clock=Time().clock_type, from_msg=Time.from_msg(TimeMessage()).clock_type)
    system = Time(seconds=5, clock_type=ClockType.SYSTEM_TIME)
    simulated = Time(seconds=5, clock_type=ClockType.ROS_TIME)
    second = Duration(seconds=1)
    pairs = {
        "time + duration": (operator.add, system, second),
        "duration + time": (operator.add, second, system),
        "time - duration": (operator.sub, system, second),
        "time - time": (operator.sub, system, Time(seconds=3)),
        "earlier - later": (operator.sub, Time(seconds=3), system),
        "time - larger duration": (operator.sub, system, Duration(seconds=9)),
        "time + time": (operator.add, system, system),
        "duration - time": (operator.sub, second, system),
        "duration + duration": (operator.add, second, second),
        "duration - duration": (operator.sub, second, Duration(seconds=3)),
        "duration * 2": (operator.mul, second, 2),
        "duration * 0.5": (operator.mul, second, 0.5),
        "duration * text": (operator.mul, second, "x"),
        "2 * duration": (operator.mul, 2, second),
        "duration / 2": (operator.truediv, second, 2),
        "- duration": (lambda value, _: -value, second, None),
        "time + 1": (operator.add, system, 1),
        "time - 1": (operator.sub, system, 1),
        "duration + 1": (operator.add, second, 1),
        "times of two clocks -": (operator.sub, system, simulated),
    }
    for name, (function, left, right) in pairs.items():
        attempt(f"arithmetic {name}", lambda f=function, a=left, b=right: show(f(a, b)))
    comparisons = ("eq", "ne", "lt", "le", "gt", "ge")
    operands = {
        "equal times": (system, Time(seconds=5)),
        "times": (system, Time(seconds=6)),
        "times of two clocks": (system, simulated),
        "time and duration": (system, Duration(seconds=5)),
        "time and int": (system, 5),
        "durations": (second, Duration(seconds=2)),
        "equal durations": (second, Duration(seconds=1)),
        "duration and int": (second, 1_000_000_000),
        "duration and None": (second, None),
    }
    for name, (left, right) in operands.items():
        for comparison in comparisons:
            attempt(f"compare {name} {comparison}", lambda c=comparison, a=left, b=right: getattr(operator, c)(a, b))
    attempt("hash time", lambda: isinstance(hash(system), int))
    attempt("hash duration", lambda: isinstance(hash(second), int))
    log("text", time=repr(system), duration=repr(second), printed=str(second))

    message = TimeMessage(sec=3, nanosec=250_000_000)
    log("from message", nanoseconds=Time.from_msg(message).nanoseconds, back=Time.from_msg(message).to_msg() == message)
    log("from message of a clock", clock=Time.from_msg(message, clock_type=ClockType.STEADY_TIME).clock_type)
    attempt("from the wrong message", lambda: Time.from_msg(DurationMessage()))
    attempt("from a duration", lambda: Duration.from_msg(TimeMessage()))

    for kind in (ClockType.ROS_TIME, ClockType.SYSTEM_TIME, ClockType.STEADY_TIME):
        clock = Clock(clock_type=kind)
        first, later = clock.now(), clock.now()
        log("clock", kind=clock.clock_type, now=first.clock_type, forward=later >= first, same=type(clock).__name__)
    log("default clock", kind=Clock().clock_type, ros=ROSClock().clock_type, active=type(ROSClock().ros_time_is_active))
    clock = Clock(clock_type=ClockType.STEADY_TIME)
    start = clock.now()
    log("sleep", result=clock.sleep_for(Duration(seconds=0.05)), passed=clock.now() - start >= Duration(seconds=0.05))
    log("sleep until", result=clock.sleep_until(clock.now() + Duration(seconds=0.01)))
    log("sleep until the past", result=clock.sleep_until(start))
    attempt("sleep on another clock", lambda: clock.sleep_until(Time(seconds=1)))


def show(value):
    if isinstance(value, (Time, Duration)):
        return [type(value).__name__, value.nanoseconds, getattr(value, "clock_type", None)]
    return value


if __name__ == "__main__":
    with ros():
        main()
