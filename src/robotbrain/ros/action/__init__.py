"""Actions (``rclpy.action``): goals that take a while, with feedback on the way, and that can be cancelled.

As in ROS 2 an action is three services and two topics: ``NAME/_action/send_goal``, ``cancel_goal`` and ``get_result``,
``NAME/_action/feedback`` and ``status``; traces, bags, taps and bridges see them under these names.

Executing a goal takes simulated time only where it says so. A plain execute callback is one piece of work: it costs
what it charges, its feedback leaves when it is over, and it never sees a cancel request that comes meanwhile. A loop
over stages is written ``async def`` with ``await`` of a future (``await robotbrain.ros.sleep(node, 0.5)``, say): it
hands back the thread, feedback leaves at once, and cancel requests arrive between the stages. That form runs on genuine
rclpy too.
"""

from __future__ import annotations

from robotbrain.ros.action.client import ActionClient
from robotbrain.ros.action.graph import (
    get_action_client_names_and_types_by_node,
    get_action_names_and_types,
    get_action_server_names_and_types_by_node,
)
from robotbrain.ros.action.server import ActionServer, CancelResponse, GoalResponse

__all__ = [
    "ActionClient",
    "ActionServer",
    "CancelResponse",
    "GoalResponse",
    "get_action_client_names_and_types_by_node",
    "get_action_names_and_types",
    "get_action_server_names_and_types_by_node",
]
