"""Differences between the kit and genuine rclpy that are meant, each with its reason.

The suite fails on a difference that is not listed here and on a listed one that no longer occurs. The kit follows
Kilted; rows for Jazzy alone are where Kilted itself is not like Jazzy.
"""

from __future__ import annotations

from tests.conformance_ros.backends import Line
from tests.conformance_ros.compare import Difference

ONLY_JAZZY = ("jazzy",)


def raised(name: str) -> tuple[Line, ...]:
    """Return the fields of an exception: the narrowest class that a program can name for it."""
    return ({"raised": name},)


def duration(nanoseconds: int) -> tuple[Line, ...]:
    """Return the fields of a duration as a result."""
    return ({"result": ["Duration", nanoseconds, None]},)


DIFFERENCES: tuple[Difference, ...] = (
    # ---------------------------------------------------------------- simulated time
    Difference(
        "timers",
        "jump",
        ({"calls": [["fast", 1300], ["fast", 1400], ["fast", 1500]], "since_last": 70000000, "until_next": 30000000},),
        ({"calls": [["fast", 1570]], "since_last": 0, "until_next": 30000000},),
        "Simulated time of the kit runs through every event and cannot jump; genuine time from /clock can, and a timer "
        "then makes one call for all the periods jumped over. Afterwards both are on the same grid.",
    ),
    Difference(
        "timers",
        "after the jump",
        ({"calls": [["fast", time] for time in (1300, 1400, 1500, 1600, 1700)]},),
        ({"calls": [["fast", time] for time in (1570, 1600, 1700)]},),
        "What came of the jump, and then the same calls.",
    ),
    Difference(
        "simulated_clock",
        "jump",
        ({"jumps": [], "no_change": False},),
        ({"jumps": [["before", 1900000000], ["ROS_TIME_NO_CHANGE", 1000000000]], "no_change": True},),
        "Simulated time of the kit cannot jump, so that jump callbacks are taken but never called.",
    ),
    Difference(
        "simulated_clock",
        "unregistered",
        ({"count": 0},),
        ({"count": 2},),
        "The two calls of the jump before, which the kit does not have.",
    ),
    Difference(
        "timers",
        "zero period",
        raised("ValueError"),
        ({"result": None},),
        "A timer without a period would never let simulated time go on.",
    ),
    # ---------------------------------------------------------------- executors
    Difference(
        "executor_single",
        "ready together",
        (
            {
                "order": ["busy", "timer", "second", "first", "service"],
                "set": ["busy", "first", "second", "service", "timer"],
            },
        ),
        (
            {
                "order": ["busy", "timer", "first", "second", "service"],
                "set": ["busy", "first", "second", "service", "timer"],
            },
        ),
        "Callbacks of the kit start in the order in which they became ready; genuine executors go through timers, "
        "subscriptions and services in order of creation. ROS 2 promises neither.",
    ),
    # ---------------------------------------------------------------- names
    Difference(
        "services_basic",
        "names",
        ({"clients": ["/switch", "/switch"], "service": "/switch"},),
        ({"clients": ["switch", "/switch"], "service": "switch"},),
        "srv_name of genuine clients and services is as given; the kit's is absolute, as service_name is on "
        "both and as topic_name of publishers and subscriptions is.",
    ),
    Difference(
        "lifecycle_of_entities",
        "entities",
        ({"clients": ["/it"], "publishers": ["/numbers"], "services": [], "subscriptions": ["/numbers"]},),
        ({"clients": ["it"], "publishers": ["/numbers"], "services": ["it"], "subscriptions": ["/numbers"]},),
        "srv_name is absolute on the kit; see services_basic.",
    ),
    Difference(
        "lifecycle_of_entities",
        "name of a destroyed node",
        ({"name": "node"},),
        ({"name": "InvalidHandle"},),
        "The kit's errors and records name nodes that have been destroyed.",
    ),
    Difference(
        "names",
        "namespace in braces, plain",
        raised("InvalidTopicNameException"),
        raised("RuntimeError"),
        "In the root namespace {ns}/x is //x, which is no name. Both refuse it; the kit's error says what is wrong.",
    ),
    # ---------------------------------------------------------------- messages
    Difference(
        "messages",
        "covariance two-dimensional",
        raised("ValueError"),
        ({"result": ["ndarray", "float64", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]},),
        "The setter takes any array of nine elements, but the field is one row of nine: a debug build of genuine ROS 2 "
        "stops the process when such a message is published, and every reader gets one row.",
    ),
    Difference(
        "messages",
        "names tuple",
        ({"result": ["list", "", ["a"]]},),
        ({"result": ["tuple", "", ["a"]]},),
        "Genuine messages keep the tuple, which cannot be appended to; the kit makes the list that a reader gets.",
    ),
    # ---------------------------------------------------------------- Jazzy is not Kilted
    *(
        Difference(
            "time_arithmetic",
            f"arithmetic {name}",
            duration(nanoseconds),
            raised("TypeError"),
            "Durations add, subtract and multiply since Kilted.",
            ONLY_JAZZY,
        )
        for name, nanoseconds in {
            "duration + duration": 2_000_000_000,
            "duration - duration": -2_000_000_000,
            "duration * 2": 2_000_000_000,
            "duration * 0.5": 500_000_000,
        }.items()
    ),
    Difference(
        "lifecycle_of_entities",
        "with",
        ({"result": "inside"},),
        raised("TypeError"),
        "A node is a context manager since Kilted.",
        ONLY_JAZZY,
    ),
    Difference(
        "lifecycle_of_entities",
        "after with",
        raised("InvalidHandle"),
        ({"result": None},),
        "On Jazzy the block before was not entered, so that the node lives on.",
        ONLY_JAZZY,
    ),
    Difference(
        "pubsub_message_info",
        "keys",
        (
            {
                "keys": [
                    "publication_sequence_number",
                    "publisher_gid",
                    "received_timestamp",
                    "reception_sequence_number",
                    "source_timestamp",
                ]
            },
        ),
        (
            {
                "keys": [
                    "publication_sequence_number",
                    "received_timestamp",
                    "reception_sequence_number",
                    "source_timestamp",
                ]
            },
        ),
        "The identity of the publisher is told since Kilted.",
        ONLY_JAZZY,
    ),
    Difference(
        "services_basic",
        "blocking call without an answer",
        raised("TimeoutError"),
        ({"result": None},),
        "A call that gets no answer in time raises since Kilted; on Jazzy it returns None.",
        ONLY_JAZZY,
    ),
    Difference(
        "services_basic",
        "done callbacks",
        ({"order": ["one True", "two", "too late"]},),
        ({"order": ["two", "one True", "too late"]},),
        "Done callbacks run in the order in which they were added since Kilted; Jazzy makes tasks of them.",
        ONLY_JAZZY,
    ),
)
