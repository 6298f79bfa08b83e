"""Signal handlers (``rclpy.signals``): accepted; in the kit Ctrl-C is Python's KeyboardInterrupt."""

from __future__ import annotations

import enum


class SignalHandlerOptions(enum.IntEnum):
    """Which signals shut the context down."""

    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3


_installed = SignalHandlerOptions.NO


def install_signal_handlers(options: SignalHandlerOptions = SignalHandlerOptions.ALL) -> None:
    """Remember the choice."""
    global _installed
    _installed = SignalHandlerOptions(options)


def uninstall_signal_handlers() -> None:
    """Forget the choice."""
    install_signal_handlers(SignalHandlerOptions.NO)


def get_current_signal_handlers_options() -> SignalHandlerOptions:
    """Return the choice."""
    return _installed
