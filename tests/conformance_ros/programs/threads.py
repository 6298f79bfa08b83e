"""An executor that spins in a thread while the main thread waits: rates, blocking calls, one message."""

import threading

import rclpy
from conformance import log, ros, steady
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import Int32
from std_srvs.srv import SetBool


def spin(executor: MultiThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        log("spin", ended="ExternalShutdownException")
    else:
        log("spin", ended="returned")


def main() -> None:
    server, user = Node("server"), Node("user")
    server.create_service(SetBool, "switch", lambda request, response: SetBool.Response(success=not request.data))
    publisher = server.create_publisher(Int32, "count", 10)
    counted: list[int] = []

    def count() -> None:
        counted.append(len(counted))
        publisher.publish(Int32(data=7))

    server.create_timer(0.05, count)
    client = user.create_client(SetBool, "switch")
    executor = MultiThreadedExecutor(num_threads=3)
    executor.add_node(server)
    executor.add_node(user)
    thread = threading.Thread(target=spin, args=(executor,), daemon=True)
    thread.start()

    log("service", there=client.wait_for_service(timeout_sec=10.0))
    log("calls", answers=[client.call(SetBool.Request(data=data)).success for data in (True, False, True)])

    rate = user.create_rate(20.0)
    clock = steady()
    rate.sleep()
    start = clock.now()
    for _ in range(4):
        rate.sleep()
    passed = clock.now() - start
    log("rate", four_periods=Duration(seconds=0.15) < passed < Duration(seconds=0.35))
    rate.destroy()

    # Of a node that nobody spins: an executor would take the message first.
    waiter = Node("waiter")
    found, message = wait_for_message(Int32, waiter, "count", time_to_wait=5.0)
    log("message", found=found, message=message)
    found, message = wait_for_message(Int32, waiter, "silence", time_to_wait=0.1)
    log("no message", found=found, message=message)
    log("timer went on meanwhile", enough=len(counted) >= 4)
    rclpy.shutdown()
    thread.join(10.0)
    log("end", alive=thread.is_alive())


if __name__ == "__main__":
    with ros():
        main()
