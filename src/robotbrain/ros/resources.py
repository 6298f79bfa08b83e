"""The resources of one device in simulated time: CPU cores, a GPU, DLAs, and how callbacks share them.

A callback's cost is a list of segments ``(resource, ns)`` that run in order, each on its resource:

- ``"cpu"`` is processor sharing, what a fair scheduler such as Linux's tends to: N callbacks that want a core of C each
  run at min(1, C / N) of full speed. It is computed as round-robin with a time slice of 1 ns, in whole numbers, so that
  no work is lost or made up by rounding, and any two callbacks that run side by side are served alike to 1 ns. Context
  switches cost nothing, caches stay warm, all cores are alike, and one callback is one thread.
- ``"gpu"``, ``"dla0"``, ``"dla1"`` serve one segment at a time, in the order of arrival, to the end. Kernels of
  different processes are in truth time-sliced on the GPU; here they take turns at the granularity of a segment, as a
  rule one inference. Throughput is the same; a short inference behind a long one waits a little too long.
- A callback that waits for the GPU or a DLA, or runs there, holds no core: it blocks and does not spin
  (``cudaDeviceScheduleBlockingSync``). Its worker and its callback group stay busy.

What has begun runs to its end, also when its node is destroyed meanwhile.

Sources: Kleinrock, "Time-shared Systems: A Theoretical Treatment", J. ACM 14(2), 1967 (processor sharing as the limit
of round-robin for vanishing time slices); the CFS scheduler's design document in the Linux kernel sources.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext

Segment = tuple[str, int]
"""A resource and how long it is wanted, ns."""

RESOURCES = ("cpu", "gpu", "dla0", "dla1")
"""Names of all resources that a device may have."""


@dataclass(slots=True)
class ResourceStats:
    """How one resource was used.

    Attributes:
        segments: pieces of work that it was given.
        demand_ns: their total length.
        waited_ns: time by which the pieces that are done took longer than their length.
        longest_wait_ns: the largest such time of one piece.
        most: pieces that wanted it at the same time, at most.
    """

    segments: int = 0
    demand_ns: int = 0
    waited_ns: int = 0
    longest_wait_ns: int = 0
    most: int = 0

    def _add_wait(self, wait_ns: int) -> None:
        self.waited_ns += wait_ns
        self.longest_wait_ns = max(self.longest_wait_ns, wait_ns)


class _Job:
    """A callback's segments on their way through the device."""

    __slots__ = ("arrived_ns", "left_ns", "place", "segments", "sequence", "then", "wanted_ns")

    def __init__(self, segments: Sequence[Segment], then: Callable[[], None], sequence: int) -> None:
        self.segments, self.place = segments, 0
        self.then = then
        self.sequence = sequence
        self.wanted_ns = self.left_ns = self.arrived_ns = 0


class DeviceResources:
    """What a device has, and who is using it. One object serves one simulation.

    Args:
        cpu_cores: cores online, >= 1.
        gpu: GPUs, 0 or 1.
        dla: deep-learning accelerators, 0 to 2.

    Attributes:
        names: the resources there are, of RESOURCES.
        stats: :class:`ResourceStats` of each.

    Raises:
        InputError: another number of anything; attached to a second simulation.
    """

    def __init__(self, cpu_cores: int = 4, gpu: int = 1, dla: int = 0) -> None:
        for label, value, low, high in (("cpu_cores", cpu_cores, 1, 1024), ("gpu", gpu, 0, 1), ("dla", dla, 0, 2)):
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise InputError(
                    label,
                    given=value,
                    expected=f"a whole number from {low} to {high}",
                    fix="Say what the module has, e.g. DeviceResources(cpu_cores=4, gpu=1, dla=0) for a Jetson Nano.",
                )
        self.cpu_cores = cpu_cores
        self.names: tuple[str, ...] = ("cpu", *["gpu"] * gpu, *(f"dla{k}" for k in range(dla)))
        self.stats: Mapping[str, ResourceStats] = {name: ResourceStats() for name in self.names}
        self._free_ns = dict.fromkeys(self.names[1:], 0)
        self._waiting: dict[str, deque[int]] = {name: deque() for name in self.names[1:]}
        self._context: SimContext | None = None
        self._start_ns = 0
        self._sequence = 0
        self._jobs: list[_Job] = []
        self._done: list[_Job] = []
        self._cpu_busy_ns = 0
        self._served_ns = 0  # time up to which the CPU's jobs have been served
        self._wake_ns: int | None = None

    def attach(self, context: SimContext) -> None:
        """Serve the callbacks of ``context`` from now on (its constructor calls this)."""
        if self._context is not None:
            raise InputError(
                "resources",
                given="a DeviceResources that serves another simulation",
                expected="one of its own for each simulation",
                fix="Make a new DeviceResources for each SimContext.",
            )
        self._context = context
        self._start_ns = self._served_ns = context.now_ns
        self._free_ns = dict.fromkeys(self._free_ns, context.now_ns)

    def check(self, resource: str) -> None:
        """Raise InputError unless the device has ``resource``."""
        if resource not in self.stats:
            cores = f"{self.cpu_cores} core{'s' if self.cpu_cores > 1 else ''}"
            raise InputError(
                "resource",
                given=resource,
                expected=f"one that this device has: {', '.join(self.names)} ({cores})",
                fix="Run it on another resource, or on a module that has this one."
                if resource in RESOURCES
                else "Resources are called " + ", ".join(RESOURCES) + ".",
            )

    # ------------------------------------------------------------ accounting

    @property
    def busy_ns(self) -> dict[str, int]:
        """Work done so far on each resource, ns; for ``"cpu"`` summed over cores (core-ns)."""
        now = self._now()
        self._serve(now)
        busy = {"cpu": self._cpu_busy_ns}
        for name, free in self._free_ns.items():
            # First come, first served: what is left of all that was given to it is done without a pause.
            busy[name] = self.stats[name].demand_ns - max(0, free - now)
        return busy

    def utilisation(self) -> dict[str, float]:
        """Share of its capacity that each resource was busy since the start, 0 to 1; 0 before any time has passed."""
        elapsed = self._now() - self._start_ns
        capacity = {name: elapsed * (self.cpu_cores if name == "cpu" else 1) for name in self.names}
        return {name: busy / capacity[name] if elapsed else 0.0 for name, busy in self.busy_ns.items()}

    # ------------------------------------------------------------ work

    def submit(self, segments: Sequence[Segment], then: Callable[[], None]) -> None:
        """Run ``segments`` in order from now on, and call ``then()`` when the last one is done.

        Lengths are whole ns, >= 1; resources must have passed :meth:`check`.
        """
        self._sequence += 1
        self._next_segment(_Job(segments, then, self._sequence))

    def _next_segment(self, job: _Job) -> None:
        if job.place == len(job.segments):
            job.then()
            return
        resource, length = job.segments[job.place]
        job.place += 1
        job.wanted_ns, job.arrived_ns = length, self._now()
        stats = self.stats[resource]
        stats.segments += 1
        stats.demand_ns += length
        if resource == "cpu":
            self._add_to_cpu(job)
        else:
            self._add_to_queue(resource, job)

    def _add_to_queue(self, resource: str, job: _Job) -> None:
        assert self._context is not None
        begin = max(job.arrived_ns, self._free_ns[resource])
        self._free_ns[resource] = end = begin + job.wanted_ns
        waiting = self._waiting[resource]
        while waiting and waiting[0] <= job.arrived_ns:
            waiting.popleft()
        waiting.append(end)
        stats = self.stats[resource]
        stats.most = max(stats.most, len(waiting))
        stats._add_wait(begin - job.arrived_ns)
        self._context.schedule(end, self._next_segment, job)

    def _add_to_cpu(self, job: _Job) -> None:
        self._serve(job.arrived_ns)
        job.left_ns = job.wanted_ns
        self._jobs.append(job)
        stats = self.stats["cpu"]
        if len(self._jobs) > stats.most:
            stats.most = len(self._jobs)
        # It ends then or, if it has to share, later; the others' ends do not come nearer.
        self._wake_at(job.arrived_ns + job.left_ns)

    def _serve(self, now_ns: int) -> None:
        """Bring the CPU's jobs up to date; no job ends before ``now_ns``."""
        elapsed, self._served_ns = now_ns - self._served_ns, now_ns
        jobs, cores = self._jobs, self.cpu_cores
        count = len(jobs)
        if not elapsed or not count:
            return
        if count <= cores:
            self._cpu_busy_ns += count * elapsed
            for job in jobs:
                job.left_ns -= elapsed
        else:
            # In each ns the next C jobs in turn get one ns each.
            dealt = cores * elapsed
            self._cpu_busy_ns += dealt
            each, first = divmod(dealt, count)
            for place, job in enumerate(jobs):
                job.left_ns -= each + (place < first)
            jobs = jobs[first:] + jobs[:first]
        self._jobs = [job for job in jobs if job.left_ns]
        if len(self._jobs) < count:
            self._done += [job for job in jobs if not job.left_ns]

    def _plan_wake(self) -> None:
        """See to it that :meth:`_wake` runs when the next job of the CPU ends."""
        jobs, cores = self._jobs, self.cpu_cores
        if not jobs:
            return
        count = len(jobs)
        if count <= cores:
            ends = self._served_ns + min([job.left_ns for job in jobs])
        else:
            last = min([place + (job.left_ns - 1) * count for place, job in enumerate(jobs)])
            ends = self._served_ns + last // cores + 1
        self._wake_at(ends)

    def _wake_at(self, ends: int) -> None:
        # A wake that turns out to be too early plans anew; that is cheaper than withdrawing it.
        if self._wake_ns is None or ends < self._wake_ns:
            assert self._context is not None
            self._wake_ns = ends
            self._context.schedule(ends, self._wake)

    def _wake(self, _: Any) -> None:
        now = self._now()
        if now != self._wake_ns:
            return
        self._wake_ns = None
        self._serve(now)
        if self._done:
            done, self._done = self._done, []
            if len(done) > 1:
                done.sort(key=attrgetter("sequence"))
            stats = self.stats["cpu"]
            for job in done:
                waited = now - job.arrived_ns - job.wanted_ns
                if waited:
                    stats._add_wait(waited)
                self._next_segment(job)
        self._plan_wake()

    def _now(self) -> int:
        if self._context is None:
            raise InputError(
                "resources",
                given="a DeviceResources without a simulation",
                expected="one that belongs to a SimContext",
                fix="Pass it to SimContext(resources=...).",
            )
        return self._context.now_ns
