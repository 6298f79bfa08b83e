"""Loggers: levels, children, filters, what is returned, what reaches /rosout."""

from conformance import attempt, executor_of, log, ros, spin_until
from rcl_interfaces.msg import Log
from rclpy.logging import LoggingSeverity, get_logger, get_logging_severity_from_string
from rclpy.node import Node


def main() -> None:
    node = Node("node", namespace="/ns")
    logger = node.get_logger()
    log("name", name=logger.name, child=logger.get_child("part").name, named=get_logger("other").name)
    log("level", effective=LoggingSeverity(logger.get_effective_level()))
    enabled = [severity for severity in LoggingSeverity if logger.is_enabled_for(severity)]
    log("enabled", severities=[severity.name for severity in enabled if severity])
    results = [logger.debug("quiet"), logger.info("info"), logger.warning("warning"), logger.error("error")]
    log("returned", results=results, fatal=logger.fatal("fatal"), by_level=logger.log("text", LoggingSeverity.INFO))

    logger.set_level(LoggingSeverity.ERROR)
    log("errors only", effective=LoggingSeverity(logger.get_effective_level()), warning=logger.warning("no"))
    child = logger.get_child("part")
    log("child follows", effective=LoggingSeverity(child.get_effective_level()))
    child.set_level(LoggingSeverity.DEBUG)
    log("child differs", child=child.debug("yes"), parent=logger.info("no"))
    log("same logger again", effective=LoggingSeverity(get_logger("ns.node").get_effective_level()))
    logger.set_level(LoggingSeverity.INFO)

    log("once", results=[logger.info("once", once=True) for _ in range(3)])
    log("skip first", results=[logger.info("skip", skip_first=True) for _ in range(3)])
    log("throttled", results=[logger.info("often", throttle_duration_sec=5.0) for _ in range(3)])
    log("names", severities=[get_logging_severity_from_string(name).name for name in ("DEBUG", "WARN", "FATAL")])
    attempt("unknown name", lambda: get_logging_severity_from_string("LOUD"))
    attempt("log of an object", lambda: logger.info([1, 2]))
    attempt("log without text", lambda: logger.info())
    attempt("level as text", lambda: logger.set_level("INFO"))
    attempt("unknown severity", lambda: logger.log("text", 17))
    attempt("unknown filter", lambda: logger.info("text", sometimes=True))

    lines: list[list] = []
    listener = Node("listener")
    executor = executor_of(node, listener)
    listener.create_subscription(
        Log,
        "/rosout",
        lambda message: lines.append([message.name, message.level, message.msg]) if "hear" in message.msg else None,
        100,
    )
    spin_until(executor, lambda: listener.count_publishers("/rosout") >= 2, 1.0)
    spin_until(executor, lambda: logger.warning("hear me") and lines, 2.0)
    log("rosout", first=lines[:1])


if __name__ == "__main__":
    with ros():
        main()
