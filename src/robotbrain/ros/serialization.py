"""CDR of whole messages (``rclpy.serialization``)."""

from __future__ import annotations

from typing import Any

from robotbrain.ros import cdr
from robotbrain.ros.messages import typename_of


def serialize_message(message: Any) -> bytes:
    """Return the CDR bytes of a message, with their 4-byte header.

    Raises:
        InputError: not a message.
    """
    typename_of(type(message))
    return cdr.to_cdr(message)


def deserialize_message(serialized_message: bytes, message_type: Any) -> Any:
    """Return the message of class ``message_type`` in CDR bytes.

    Raises:
        InputError: not a message class, or not the bytes of such a message.
    """
    typename_of(message_type)
    return cdr.from_cdr(serialized_message, message_type)
