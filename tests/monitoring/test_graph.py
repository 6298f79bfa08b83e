"""The graph of a run: edges counted against a run whose graph is known, and a figure that shows all of them."""

from __future__ import annotations

import pytest

import robotbrain.ros  # makes rclpy importable
from robotbrain.errors import InputError
from robotbrain.monitoring.graph import edges, plot_graph
from robotbrain.monitoring.trace import Recorder, Trace
from robotbrain.ros import SimContext

assert robotbrain.ros.BACKEND == "kit"


@pytest.fixture
def trace() -> Trace:
    """Ten seconds: /a publishes at 10 Hz, /b and /c listen, /b asks /c once a second."""
    from rclpy.node import Node
    from std_msgs.msg import String
    from std_srvs.srv import Trigger

    context = SimContext()
    recorder = Recorder(context, title="known")
    with context.as_default():
        a, b, c = Node("a"), Node("b"), Node("c")
        publisher = a.create_publisher(String, "words", 10)
        unheard = a.create_publisher(String, "unheard", 10)
        a.create_timer(0.1, lambda: (publisher.publish(String(data="12345678")), unheard.publish(String())))
        b.create_subscription(String, "words", lambda msg: None, 10)
        c.create_subscription(String, "words", lambda msg: None, 10)
        c.create_service(Trigger, "ask", lambda request, response: response)
        client = b.create_client(Trigger, "ask")
        b.create_timer(1.0, lambda: client.call_async(Trigger.Request()))
        context.run_for(10.0)
    return recorder.trace()


def test_every_edge_is_there_with_its_rate_and_size(trace: Trace) -> None:
    found = {(e.source, e.target, e.name): e for e in edges(trace)}
    assert set(found) == {("/a", "/b", "/words"), ("/a", "/c", "/words"), ("/b", "/c", "/ask")}
    words, ask = found["/a", "/b", "/words"], found["/b", "/c", "/ask"]
    assert (words.count, words.rate_hz, words.kind) == (100, pytest.approx(10.0), "topic")
    assert words.mean_size == 4 + 4 + 9  # encapsulation, length, eight characters and their end
    assert (ask.count, ask.kind, ask.type_name) == (10, "service", "std_srvs/srv/Trigger")


def test_the_figure_says_in_words_what_it_shows(trace: Trace) -> None:
    words = plot_graph(trace).get_label()
    for part in ("a to b by topic /words, 10 Hz", "a to c by topic /words, 10 Hz", "b to c by service /ask, 1 Hz"):
        assert part in words


def test_rows_are_in_the_order_asked_for_and_complete(trace: Trace) -> None:
    axes = plot_graph(trace, ["/c", "/a", "/b"]).axes[0]
    heights = dict(zip([t.get_text() for t in axes.get_yticklabels()], axes.get_yticks(), strict=True))
    assert heights["c"] > heights["a"] > heights["b"]
    for wrong in (["/a", "/b"], ["/a", "/b", "/c", "/d"], ["/a", "/a", "/b", "/c"]):
        with pytest.raises(InputError, match="nodes of a graph"):
            plot_graph(trace, wrong)


def test_a_run_without_messages_has_no_graph() -> None:
    recorder = Recorder(SimContext())
    assert edges(recorder.trace()) == []
    with pytest.raises(InputError, match="there are none"):
        plot_graph(recorder.trace())
