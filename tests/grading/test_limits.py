from __future__ import annotations

import threading
import time

import pytest

from robotbrain.grading import limits
from robotbrain.grading.limits import TimeLimitError, time_limit


def test_code_in_time_is_left_alone() -> None:
    with time_limit(30.0):
        total = sum(range(1000))
    assert total == 499500


def test_the_alarm_is_gone_afterwards() -> None:
    with pytest.raises(TimeLimitError), time_limit(0.05):
        while True:
            pass
    time.sleep(0.3)  # a forgotten alarm would go off here


def test_limits_work_outside_the_main_thread() -> None:
    caught: list[str] = []

    def work() -> None:
        try:
            with time_limit(0.1):
                while True:
                    pass
        except TimeLimitError:
            caught.append("limit")
        with time_limit(30.0):
            caught.append("after")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(30)
    assert caught == ["limit", "after"]


def test_the_thread_guard_also_works_in_the_main_thread() -> None:
    with pytest.raises(TimeLimitError), limits._by_thread(0.05):
        while True:
            pass
