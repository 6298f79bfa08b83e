"""The emergency stop from afar, for a person at another terminal."""

from __future__ import annotations

from robotbrain.link.handshake import DEFAULT_PORT, LinkError
from robotbrain.link.local import LinkClient
from robotbrain.link.runtime import KitRuntime, use_kit


def emergency_stop(
    stop: bool, host: str = "127.0.0.1", port: int = DEFAULT_PORT, token: str | None = None, timeout_s: float = 5.0
) -> str:
    """Set (True) or release (False) the emergency stop of a robot on the local transport; return its answer.

    Raises:
        LinkError: the robot cannot be reached, or did not answer.
    """
    use_kit()
    runtime = KitRuntime()
    client = LinkClient(runtime.context, host, port, token)
    try:
        from rclpy.node import Node
        from std_srvs.srv import SetBool

        node = runtime.make(lambda: Node("operator"))
        service = node.create_client(SetBool, "emergency_stop")
        runtime.run(lambda: client.refusal is not None or service.service_is_ready(), timeout_s)
        if client.refusal is not None:
            raise client.refusal
        if not service.service_is_ready():
            raise LinkError(client.state)
        future = service.call_async(SetBool.Request(data=stop))
        if not runtime.run(future.done, timeout_s):
            raise LinkError("the robot did not answer: use its switch")
        return str(future.result().message)
    finally:
        client.close()
        runtime.close()
