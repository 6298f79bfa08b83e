"""A device's cores, GPU and DLAs against closed forms, a brute-force scheduler and invariants."""

from __future__ import annotations

import itertools
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from robotbrain.errors import InputError
from robotbrain.ros import CallbackError, DeviceResources, SimContext, charge, charge_work
from robotbrain.ros.record import DecisionLog

MS = 1_000_000


def run_jobs(jobs, **device):
    """Ends of jobs ``(arrival_ns, [(resource, ns), ...])`` and the device, after all are done."""
    resources = DeviceResources(**device)
    context = SimContext(resources=resources)
    ends = [None] * len(jobs)

    def submit(index):
        resources.submit(jobs[index][1], lambda: ends.__setitem__(index, context.now_ns))

    for index, (arrival, _) in enumerate(jobs):
        context.schedule(arrival, submit, index)
    while context.step():
        pass
    return ends, resources


def cpu_jobs(*jobs):
    return [(arrival, [("cpu", demand)]) for arrival, demand in jobs]


# ------------------------------------------------------------ closed forms


@pytest.mark.parametrize(("jobs", "cores"), [(1, 1), (3, 1), (3, 2), (4, 4), (7, 3), (2, 6), (12, 5)])
def test_equal_jobs_end_together_after_their_share(jobs, cores):
    """k jobs of d on c cores: each runs at min(1, c/k), so all end at d * max(1, k/c), to the last few slices."""
    demand = 10 * MS
    ends, resources = run_jobs(cpu_jobs(*[(0, demand)] * jobs), cpu_cores=cores)
    ideal = max(Fraction(demand), Fraction(demand * jobs, cores))
    assert all(ideal - -(-jobs // cores) <= end <= ideal + 1 for end in ends)
    assert max(ends) == -(-ideal.numerator // ideal.denominator)
    assert resources.busy_ns["cpu"] == jobs * demand
    assert resources.stats["cpu"].most == jobs


def test_staggered_arrivals_share_while_both_run():
    """One core, 10 ms at t = 0 and 4 ms at t = 6: shared from 6 on, both have 4 left, so both end at 14."""
    ends, _ = run_jobs(cpu_jobs((0, 10 * MS), (6 * MS, 4 * MS)), cpu_cores=1)
    assert ends == [14 * MS - 1, 14 * MS]
    # 2 ms at t = 6: ends at 10, when the first has 2 ms left: 12
    ends, resources = run_jobs(cpu_jobs((0, 10 * MS), (6 * MS, 2 * MS)), cpu_cores=1)
    assert ends == [12 * MS, 10 * MS]
    assert resources.stats["cpu"].waited_ns == 4 * MS
    assert resources.stats["cpu"].longest_wait_ns == 2 * MS


def test_a_short_job_is_not_stuck_behind_long_ones_on_the_cpu_but_is_on_the_gpu():
    cpu, _ = run_jobs(cpu_jobs((0, 100 * MS), (0, 100 * MS), (0, MS)), cpu_cores=1)
    assert cpu[2] == 3 * MS
    gpu, resources = run_jobs([(0, [("gpu", 100 * MS)]), (0, [("gpu", 100 * MS)]), (0, [("gpu", MS)])])
    assert gpu == [100 * MS, 200 * MS, 201 * MS]
    stats = resources.stats["gpu"]
    assert (stats.segments, stats.most, stats.waited_ns, stats.longest_wait_ns) == (3, 3, 300 * MS, 200 * MS)


def test_the_gpu_serves_in_order_of_arrival_and_idles_between():
    arrivals, lengths = [0, 3, 4, 30], [10, 5, 1, 2]
    ends, resources = run_jobs([(a * MS, [("gpu", n * MS)]) for a, n in zip(arrivals, lengths, strict=True)])
    assert ends == [10 * MS, 15 * MS, 16 * MS, 32 * MS]
    assert resources.busy_ns["gpu"] == 18 * MS
    assert resources.utilisation()["gpu"] == pytest.approx(18 / 32)


def test_a_job_on_the_gpu_holds_no_core():
    """CPU 2, GPU 6, CPU 2 twice on one core: while one infers the other computes."""
    chain = [("cpu", 2 * MS), ("gpu", 6 * MS), ("cpu", 2 * MS)]
    ends, resources = run_jobs([(0, chain), (2 * MS, chain)], cpu_cores=1)
    # first: 0-2 cpu, 2-8 gpu, 8-10 cpu; second: 2-4 cpu, waits for the GPU until 8, 8-14 gpu, 14-16 cpu
    assert ends == [10 * MS, 16 * MS]
    assert resources.busy_ns == {"cpu": 8 * MS, "gpu": 12 * MS}


def test_dlas_and_gpu_run_side_by_side():
    ends, _ = run_jobs([(0, [(name, 5 * MS)]) for name in ("gpu", "dla0", "dla1", "dla1")], dla=2)
    assert ends == [5 * MS, 5 * MS, 5 * MS, 10 * MS]


# ------------------------------------------------------------ a brute-force scheduler as oracle


def round_robin(jobs, cores):
    """Deal out nanoseconds one by one: each ns the next ``cores`` jobs in turn get one."""
    queue, ends, time = [], [None] * len(jobs), 0
    left = [demand for _, demand in jobs]
    while None in ends:
        queue += [k for k, (arrival, _) in enumerate(jobs) if arrival == time]
        served, queue = queue[:cores], queue[cores:]
        time += 1
        for k in served:
            left[k] -= 1
            if left[k]:
                queue.append(k)
            else:
                ends[k] = time
    return ends


JOBS = st.lists(st.tuples(st.integers(0, 40), st.integers(1, 25)), min_size=1, max_size=9)


@settings(max_examples=300, deadline=None)
@given(JOBS, st.integers(1, 5))
def test_the_cpu_agrees_with_a_scheduler_that_deals_out_nanoseconds(jobs, cores):
    jobs = sorted(jobs, key=lambda job: job[0])
    assert run_jobs(cpu_jobs(*jobs), cpu_cores=cores)[0] == round_robin(jobs, cores)


def fluid_ends(jobs, cores):
    """Exact processor sharing in fractions."""
    left = {k: Fraction(demand) for k, (_, demand) in enumerate(jobs)}
    ends, time, active = {}, Fraction(0), set()
    while len(ends) < len(jobs):
        active |= {k for k, (arrival, _) in enumerate(jobs) if arrival <= time and k not in ends}
        upcoming = [Fraction(arrival) for k, (arrival, _) in enumerate(jobs) if k not in ends and arrival > time]
        rate = min(Fraction(1), Fraction(cores, max(len(active), 1)))
        if active:
            upcoming.append(time + min(left[k] for k in active) / rate)
        step = min(upcoming) - time
        time += step
        for k in list(active):
            left[k] -= rate * step
            if not left[k]:
                active.discard(k)
                ends[k] = time
    return [ends[k] for k in range(len(jobs))]


LONG_JOBS = st.lists(st.tuples(st.integers(0, 10**7), st.integers(1, 10**7)), min_size=1, max_size=12)


@settings(max_examples=200, deadline=None)
@given(LONG_JOBS, st.integers(1, 4))
def test_the_cpu_is_processor_sharing_to_a_few_nanoseconds_without_drift(jobs, cores):
    ends, resources = run_jobs(cpu_jobs(*jobs), cpu_cores=cores)
    for end, ideal in zip(ends, fluid_ends(jobs, cores), strict=True):
        assert abs(end - ideal) <= 2 * len(jobs)
    assert resources.busy_ns["cpu"] == sum(demand for _, demand in jobs)


# ------------------------------------------------------------ invariants

SEGMENTS = st.lists(st.tuples(st.sampled_from(["cpu", "gpu", "dla0"]), st.integers(1, 5 * MS)), min_size=1, max_size=4)
MIXED = st.lists(st.tuples(st.integers(0, 20 * MS), SEGMENTS), min_size=1, max_size=10)


@settings(max_examples=200, deadline=None)
@given(MIXED, st.integers(1, 4))
def test_work_is_conserved_and_nobody_ends_before_its_demand(jobs, cores):
    ends, resources = run_jobs(jobs, cpu_cores=cores, dla=1)
    for name in resources.names:
        demand = sum(length for _, segments in jobs for resource, length in segments if resource == name)
        assert resources.busy_ns[name] == demand == resources.stats[name].demand_ns
    for (arrival, segments), end in zip(jobs, ends, strict=True):
        assert end >= arrival + sum(length for _, length in segments)
    waited = sum(stats.waited_ns for stats in resources.stats.values())
    assert (
        sum(end - arrival - sum(n for _, n in segments) for (arrival, segments), end in zip(jobs, ends, strict=True))
        == waited
    )


@settings(max_examples=150, deadline=None)
@given(LONG_JOBS, st.integers(1, 4), st.integers(1, 4))
def test_more_cores_are_never_later(jobs, cores, more):
    few, _ = run_jobs(cpu_jobs(*jobs), cpu_cores=cores)
    many, _ = run_jobs(cpu_jobs(*jobs), cpu_cores=cores + more)
    # to the slice: who of two equal jobs gets the last nanosecond first may change
    assert all(later <= sooner + len(jobs) for sooner, later in zip(few, many, strict=True))


@settings(max_examples=100, deadline=None)
@given(SEGMENTS, st.integers(1, 4), st.integers(0, 10**12))
def test_a_job_alone_takes_exactly_its_demand(segments, cores, arrival):
    ends, _ = run_jobs([(arrival, segments)], cpu_cores=cores, dla=1)
    assert ends == [arrival + sum(length for _, length in segments)]


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 10**6), st.integers(1, 10**6)), min_size=2, max_size=8),
    st.integers(1, 3),
    st.randoms(),
)
def test_who_submits_does_not_matter(jobs, cores, random):
    """Jobs of different arrival times may be announced in any order."""
    arrivals = list(itertools.accumulate(arrival + 1 for arrival, _ in jobs))
    jobs = [(arrival, demand) for arrival, (_, demand) in zip(arrivals, jobs, strict=True)]
    order = list(range(len(jobs)))
    random.shuffle(order)
    ends, _ = run_jobs(cpu_jobs(*jobs), cpu_cores=cores)
    shuffled, _ = run_jobs(cpu_jobs(*[jobs[k] for k in order]), cpu_cores=cores)
    assert [ends[k] for k in order] == shuffled


@settings(max_examples=50, deadline=None)
@given(MIXED, st.integers(1, 3))
def test_accounts_are_right_at_any_moment(jobs, cores):
    """Busy time never exceeds capacity nor falls, and looking at it changes nothing."""
    resources = DeviceResources(cpu_cores=cores, dla=1)
    context = SimContext(resources=resources)
    ends = []
    for index, (arrival, segments) in enumerate(jobs):
        context.schedule(
            arrival, lambda s, k=index: resources.submit(s, lambda: ends.append((k, context.now_ns))), segments
        )
    before = dict.fromkeys(resources.names, 0)
    for _ in range(400):
        context.run_until(context.now_ns + 777_777)
        now = resources.busy_ns
        for name in resources.names:
            capacity = 777_777 * (cores if name == "cpu" else 1)
            assert 0 <= now[name] - before[name] <= capacity
        before = now
    undisturbed, _ = run_jobs(jobs, cpu_cores=cores, dla=1)
    assert [end for _, end in sorted(ends)] == undisturbed


# ------------------------------------------------------------ executors on a device


@pytest.fixture
def small():
    """One core and a GPU."""
    simulation = SimContext(resources=DeviceResources(cpu_cores=1))
    simulation.log_sink = lambda line: None
    with simulation.as_default():
        yield simulation


def test_two_nodes_contend_for_one_core(small):
    """Two timers due at once, 10 ms each, on one core: both end at 20 ms after, and publish only then."""
    log, records = [], []
    small.add_tap(lambda time, topic, *_: log.append((time, topic)))
    small.add_callback_tap(records.append)
    for name in ("a", "b"):
        node = Node(name)
        publisher = node.create_publisher(Int64, name, 1)
        node.create_timer(0.1, lambda publisher=publisher: (charge(10 * MS), publisher.publish(Int64())))
    small.run_until(150 * MS)
    assert log == [(120 * MS - 1, "/a"), (120 * MS, "/b")]
    assert [(r.node, r.start_ns, r.end_ns, r.demand_ns) for r in records] == [
        ("/a", 100 * MS, 120 * MS - 1, 10 * MS),
        ("/b", 100 * MS, 120 * MS, 10 * MS),
    ]
    assert [r.contention_ns for r in records] == [10 * MS - 1, 10 * MS]
    assert records[0].segments == (("cpu", 10 * MS),) and records[0].queued_ns == 0
    assert small.resources.busy_ns == {"cpu": 20 * MS, "gpu": 0}


def test_without_resources_segments_add_up():
    context, log = SimContext(), []
    context.add_tap(lambda time, topic, *_: log.append((time, topic)))
    for name in ("a", "b"):
        node = Node(name, context=context)
        publisher = node.create_publisher(Int64, name, 1)
        node.create_timer(
            0.1, lambda publisher=publisher: (charge(MS), charge(5 * MS, "gpu"), charge(MS), publisher.publish(Int64()))
        )
    context.run_until(150 * MS)
    assert log == [(107 * MS, "/a"), (107 * MS, "/b")]


def test_cpu_time_after_cpu_time_is_one_segment_but_two_inferences_are_two(small):
    node, records = Node("n"), []

    def tick():
        for length, resource in ((2, "cpu"), (3, "cpu"), (0, "gpu"), (1, "cpu"), (4, "gpu"), (5, "gpu"), (7, "cpu")):
            charge(length * MS, resource)

    node.create_timer(0.1, tick)
    small.add_callback_tap(records.append)
    small.run_until(150 * MS)
    expected = [("cpu", 6), ("gpu", 4), ("gpu", 5), ("cpu", 7)]
    assert records[0].segments == tuple((resource, length * MS) for resource, length in expected)


@pytest.mark.parametrize(("group", "ends"), [("exclusive", [20, 30]), ("reentrant", [22, 28])])
def test_workers_and_groups_stay_busy_while_the_gpu_works(small, group, ends):
    """Two messages at t = 10, each CPU 2, GPU 6, CPU 2: one group lets the second start at 10 or only at 20."""
    records = []
    node, sender = Node("n"), Node("s")
    MultiThreadedExecutor(2).add_node(node)
    made = ReentrantCallbackGroup() if group == "reentrant" else MutuallyExclusiveCallbackGroup()

    def infer(_message):
        charge(2 * MS)
        charge(6 * MS, resource="gpu")
        charge(2 * MS)

    node.create_subscription(Int64, "t", infer, 10, callback_group=made)
    publisher = sender.create_publisher(Int64, "t", 10)
    once = sender.create_timer(0.01, lambda: (publisher.publish(Int64()), publisher.publish(Int64()), once.cancel()))
    small.add_callback_tap(lambda r: records.append(r) if r.node == "/n" else None)
    small.run_until(100 * MS)
    # reentrant: both prepare on the one core until 14; the GPU serves them until 20 and 26; then 2 ms of CPU each
    assert [round(r.end_ns / MS) for r in records] == ends


def test_a_service_answers_when_its_work_is_done(small):
    server, client_node, hog, seen = Node("server"), Node("client"), Node("hog"), []
    hog.create_timer(0.01, lambda: charge(5 * MS))

    def answer(_request, response):
        charge(5 * MS)
        return response

    server.create_service(Trigger, "work", answer)
    client = client_node.create_client(Trigger, "work")
    once = client_node.create_timer(
        0.01,
        lambda: (
            once.cancel(),
            client.call_async(Trigger.Request()).add_done_callback(lambda _: seen.append(small.now_ns)),
        ),
    )
    small.run_until(19 * MS)
    assert seen == []
    small.run_until(40 * MS)
    assert seen == [20 * MS]


def test_coroutines_pay_part_by_part(small):
    server, node, records = Node("server"), Node("n"), []
    server.create_service(Trigger, "work", lambda request, response: (charge(3 * MS), response)[1])
    client = node.create_client(Trigger, "work", callback_group=ReentrantCallbackGroup())

    async def tick():
        charge(2 * MS)
        await client.call_async(Trigger.Request())
        charge(4 * MS, "gpu")
        timer.cancel()

    timer = node.create_timer(0.01, tick)
    small.add_callback_tap(lambda r: records.append((r.node, r.start_ns // MS, r.end_ns // MS, r.segments)))
    small.run_until(50 * MS)
    assert [r for r in records if r[0] == "/n" and r[3]] == [
        ("/n", 10, 12, (("cpu", 2 * MS),)),
        ("/n", 15, 19, (("gpu", 4 * MS),)),
    ]


def test_a_failing_callback_pays_for_what_it_did_and_its_node_can_go_on(small):
    node, ends = Node("n"), []

    def tick():
        charge(3 * MS)
        raise ZeroDivisionError

    node.create_timer(0.01, tick)
    small.add_callback_tap(lambda r: ends.append(r.end_ns // MS))
    for _ in range(2):
        with pytest.raises(CallbackError):
            small.run_until(100 * MS)
    small.on_callback_error = lambda error: True
    small.run_until(35 * MS)
    assert ends == [13, 23, 33]


def test_a_node_destroyed_at_work_leaves_the_device_usable(small):
    doomed, other, ends = Node("doomed"), Node("other"), []
    doomed.create_timer(0.01, lambda: charge(10 * MS))
    once = other.create_timer(0.015, lambda: (once.cancel(), charge(5 * MS)))
    small.add_callback_tap(lambda r: ends.append((r.node, round(r.end_ns / MS))))
    small.schedule(12 * MS, lambda _: doomed.destroy_node())
    small.run_until(100 * MS)
    # what had begun goes on: alone until 15, then shared until both have had 5 ms more
    assert ends == [("/doomed", 25), ("/other", 25)]
    assert small.resources.busy_ns["cpu"] == 15 * MS


def test_an_executor_that_is_shut_down_finishes_what_it_began(small):
    node, ends = Node("n"), []
    node.create_timer(0.01, lambda: charge(4 * MS))
    small.add_callback_tap(lambda r: ends.append(r.end_ns))
    executor = node.executor
    small.run_until(12 * MS)
    executor.shutdown()
    small.run_until(100 * MS)
    assert ends == [14 * MS] and executor.get_nodes() == []
    executor.add_node(node)
    small.run_until(105 * MS)
    assert ends == [14 * MS, 104 * MS]


class Prices:
    """1 us a unit of ``cells``; 2 ms for what charged nothing; 10 ns a byte."""

    def cost(self, node_name, kind, name):
        return 1000

    def work_ns(self, kind, units):
        return {"cells": 1000}[kind] * units

    def uncharged_ns(self, node_name, kind, name):
        return 2 * MS

    def traffic_ns(self, node_name, received, sent):
        return 10 * ((received or 0) + sum(sent))


def test_the_cost_model_prices_work_idleness_and_traffic(small):
    small.cost_model, records = Prices(), []
    a, b = Node("a"), Node("b")
    publisher = a.create_publisher(Int64, "t", 1)
    a.create_timer(0.01, lambda: (charge_work("cells", 7), charge(MS, "gpu"), publisher.publish(Int64())))
    b.create_subscription(Int64, "t", lambda message: None, 1)
    small.add_callback_tap(lambda r: records.append((r.node, r.segments)))
    small.run_until(14 * MS)
    size = 12  # bytes of an Int64 with its CDR header
    assert records == [
        ("/a", (("cpu", 1000 + 7000), ("gpu", MS), ("cpu", 10 * size))),
        ("/b", (("cpu", 1000 + 2 * MS + 10 * size),)),
    ]


def test_work_is_free_without_a_model_and_outside_callbacks(small):
    node, ends = Node("n"), []
    assert charge_work("cells", 5) is False and charge(5, "gpu") is False
    node.create_timer(0.01, lambda: ends.append(charge_work("anything", 10**9)))
    small.add_callback_tap(lambda r: ends.append(r.end_ns))
    small.run_until(15 * MS)
    assert ends == [True, 10 * MS]


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda: charge(5, "dla0"), "cpu, gpu"),
        (lambda: charge(5, "npu"), "dla1"),
        (lambda: charge_work("cells", -1), "units >= 0"),
        (lambda: charge_work("cells", float("nan")), "units >= 0"),
    ],
)
def test_what_the_device_does_not_have_is_refused_with_what_it_has(small, act, words):
    Node("n").create_timer(0.01, act)
    with pytest.raises(CallbackError) as caught:
        small.run_until(20 * MS)
    assert isinstance(caught.value.__cause__, InputError) and words in str(caught.value.__cause__)


@pytest.mark.parametrize("device", [{"cpu_cores": 0}, {"cpu_cores": 2.0}, {"gpu": 2}, {"dla": -1}, {"dla": True}])
def test_impossible_devices_are_refused(device):
    with pytest.raises(InputError, match="whole number"):
        DeviceResources(**device)


def test_one_device_serves_one_simulation():
    resources = DeviceResources()
    with pytest.raises(InputError, match="SimContext"):
        _ = resources.busy_ns
    SimContext(resources=resources)
    with pytest.raises(InputError, match="another simulation"):
        SimContext(resources=resources)


def test_a_run_on_a_device_repeats():
    def run():
        context = SimContext(resources=DeviceResources(cpu_cores=2))
        log = DecisionLog(context)
        for index in range(5):
            node = Node(f"n{index}", context=context)
            publisher = node.create_publisher(Int64, "t", 5)

            def tick(publisher=publisher, index=index, node=node):
                charge((index + 1) * 333_333)
                charge(index * 100_001, "gpu")
                publisher.publish(Int64(data=node.get_clock().now().nanoseconds))

            node.create_timer(0.005, tick)
            node.create_subscription(Int64, "t", lambda message: charge(123_457), 3)
        context.run_until(300 * MS)
        return log.sha256()

    assert run() == run()
