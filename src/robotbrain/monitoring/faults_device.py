"""Faults of the computer instead of the sensors: it gets hot, somebody else wants its cores, it is slow for a while."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.monitoring.faults_base import Fault, Remover, Window, check_number
from robotbrain.ros.resources import RESOURCES

if TYPE_CHECKING:
    from robotbrain.jetson.profiles import JetsonProfile
    from robotbrain.jetson.twin.runtime import Cooling
    from robotbrain.ros.context import SimContext


@dataclass(frozen=True)
class CpuHog(Fault):
    """A background program that burns CPU time, e.g. an indexer or an update.

    Attributes:
        threads: of it, >= 1.
        duty: share of the time that each wants a core, 0 to 1.
        period_ms: of its bursts, ms.
        name: of its node, which appears in traces.
    """

    threads: int = 4
    duty: float = 1.0
    period_ms: float = 50.0
    name: str = "cpu_hog"

    def __post_init__(self) -> None:
        if isinstance(self.threads, bool) or not isinstance(self.threads, int) or not 1 <= self.threads <= 1024:
            raise InputError("threads", given=self.threads, expected="a whole number from 1 to 1024", fix="4, say.")
        check_number("duty", self.duty, 0, 1, "1 is all the time.")
        check_number("period_ms", self.period_ms, 0.1, 1e6, "Milliseconds.")

    def install(self, context: SimContext) -> Remover:
        """Put the fault into a simulation; return a function that takes it out again."""
        from robotbrain.ros.callback_groups import MutuallyExclusiveCallbackGroup
        from robotbrain.ros.executors import Executor
        from robotbrain.ros.node import Node

        node = Node(self.name, context=context, use_global_arguments=False, start_parameter_services=False)
        Executor(context=context, num_threads=self.threads).add_node(node)
        burst_ns = round(self.duty * self.period_ms * 1e6)

        for number in range(self.threads):

            def burn() -> None:
                context.charge(burst_ns)

            # Timers are told apart in a trace by the names of their callbacks.
            burn.__name__ = f"burn{number}"
            node.create_timer(self.period_ms * 1e-3, burn, MutuallyExclusiveCallbackGroup())
        return node.destroy_node


@dataclass(frozen=True)
class Slowdown(Fault):
    """A resource that is slower for a while, e.g. in a lower power mode.

    Attributes:
        resource: ``cpu``, ``gpu``, ``dla0`` or ``dla1``.
        factor: how many times longer everything takes.
        during: (from, to), s; None: always.
    """

    resource: str
    factor: float
    during: Window | None = None

    def __post_init__(self) -> None:
        if self.resource not in RESOURCES:
            raise InputError("resource", given=self.resource, expected="one of " + ", ".join(RESOURCES), fix="'gpu'.")
        check_number("factor", self.factor, 0.001, 1e6, "2 takes twice as long.")
        if self.during is not None:
            check_number("end of a fault", self.during[1], self.during[0], float("inf"), "Not before it begins.")

    def install(self, context: SimContext) -> Remover:
        """Put the fault into a simulation; return a function that takes it out again."""
        on = False

        def switch(wanted: bool) -> None:
            nonlocal on
            if wanted != on:
                on = wanted
                slow_down(context, self.resource, self.factor if wanted else 1 / self.factor)

        removed = False

        def remove() -> None:
            nonlocal removed
            removed = True
            switch(False)

        def at(wanted: bool) -> None:
            if not removed:
                switch(wanted)

        if self.during is None:
            switch(True)
        else:
            for time, wanted in zip(self.during, (True, False), strict=True):
                if time < float("inf"):
                    context.schedule(round(time * 1e9), at, wanted)
        return remove


def slow_down(context: SimContext, resource: str, factor: float) -> None:
    """Make a resource so many times slower than it is now, whatever else slows it down."""
    product = context.slowdown.get(resource, 1.0) * factor
    # What was slowed down and is no longer is just as it was, not nearly.
    context.slowdown[resource] = 1.0 if abs(product - 1) < 1e-12 else product


@dataclass
class HeatLog:
    """What a throttling device went through.

    Attributes:
        time_s, temperature_c, power_w, clock: at each step of its governor; the clock as a share of the mode's.
    """

    time_s: list[float] = field(default_factory=list)
    temperature_c: list[float] = field(default_factory=list)
    power_w: list[float] = field(default_factory=list)
    clock: list[float] = field(default_factory=list)

    @property
    def throttled_s(self) -> float:
        """How long clocks were lowered, s."""
        pairs = zip(self.time_s, self.time_s[1:], self.clock, strict=False)
        return sum(later - now for now, later, clock in pairs if clock < 1)


@dataclass(frozen=True)
class ThermalThrottling(Fault):
    """A module that heats up by its own work and lowers its clocks at the trip point, as the twin says.

    Power follows from how busy GPU and cores were since the last step (the twin's fitted model), temperature from power
    (one thermal mass), clocks from temperature (a governor that moves by a tenth), and times from clocks. A fan that
    stands still and hot air make it matter; a drive is short against the time constant, so let it start warm.

    Attributes:
        profile: Jetson: ``slug``, ``slug:mode`` or a profile; the one that the brain runs on.
        ambient_c: temperature of the air, degC; None: a room.
        cooling: ``fan`` or ``passive``.
        start_c: of the module at the start, degC; None: the air's.
        step_s: between two steps of the governor, s.
        use: share of the GPU's peak while it is busy, 0 to 1 (a typical network's).
        log: is given what happened, one run after the other.
    """

    profile: str | JetsonProfile
    ambient_c: float | None = None
    cooling: Cooling = "fan"
    start_c: float | None = None
    step_s: float = 1.0
    use: float = 0.3
    log: HeatLog = field(default_factory=HeatLog, compare=False, repr=False)

    def __post_init__(self) -> None:
        from robotbrain.jetson.catalogue import load_module
        from robotbrain.jetson.twin.runtime import thermal_model

        if self.start_c is not None:
            check_number("start_c", self.start_c, -40, 120, "Degrees Celsius.")
        check_number("step_s", self.step_s, 0.01, 60, "Seconds.")
        check_number("use", self.use, 0, 1, "0.3 is typical.")
        thermal_model(load_module(self._profile().slug), self.cooling, self.ambient_c)

    def _profile(self) -> JetsonProfile:
        from robotbrain.jetson.profiles import load_profile

        return load_profile(self.profile) if isinstance(self.profile, str) else self.profile

    def install(self, context: SimContext) -> Remover:
        """Put the fault into a simulation; return a function that takes it out again.

        Raises:
            InputError: if the simulation has no device to heat up.
        """
        if context.resources is None:
            raise InputError(
                "simulation",
                given="no resources",
                expected="a device whose use can be followed",
                fix="Make it with SimContext(resources=DeviceResources(...)), as drive() does.",
            )
        governor = _Governor(self, context)
        context.schedule(context.now_ns, governor.step)
        return governor.stop


class _Governor:
    """Steps a module's temperature and clock through a run."""

    def __init__(self, fault: ThermalThrottling, context: SimContext) -> None:
        from robotbrain.jetson.catalogue import load_module
        from robotbrain.jetson.twin.calibrate import load_calibration
        from robotbrain.jetson.twin.runtime import thermal_model

        self._fault, self._context = fault, context
        profile = fault._profile()
        self._module = load_module(profile.slug)
        self._mode = self._module.mode(profile.power_mode)
        self._heat = thermal_model(self._module, fault.cooling, fault.ambient_c)
        self._power = load_calibration().power
        self._temperature = self._heat.ambient_c if fault.start_c is None else float(fault.start_c)
        self._clock = 1.0
        self._factor = 1.0
        self._busy: dict[str, int] = {}
        self._last_ns = context.now_ns
        self._stopped = False

    def stop(self) -> None:
        self._stopped = True
        self._slow(1.0)

    def step(self, _: object = None) -> None:
        if self._stopped:
            return
        context, heat = self._context, self._heat
        power = self._spent_w()
        elapsed = (context.now_ns - self._last_ns) * 1e-9
        self._last_ns = context.now_ns
        if elapsed:
            self._temperature = heat.after(self._temperature, power, elapsed)
        # The governor of the twin's simulate_heat: a tenth at a time.
        if self._temperature >= heat.throttle_c:
            self._clock = max(0.2, round(self._clock - 0.1, 1))
        elif self._temperature < heat.throttle_c - heat.hysteresis_c:
            self._clock = min(1.0, round(self._clock + 0.1, 1))
        self._slow(1 / self._clock)
        log = self._fault.log
        log.time_s.append(context.now_ns * 1e-9)
        log.temperature_c.append(self._temperature)
        log.power_w.append(power)
        log.clock.append(self._clock)
        context.schedule(context.now_ns + round(self._fault.step_s * 1e9), self.step)

    def _spent_w(self) -> float:
        """Return the mean power since the last step, W."""
        from dataclasses import replace

        from robotbrain.jetson.twin.power import cpu_power_w

        assert self._context.resources is not None
        busy = self._context.resources.busy_ns
        elapsed = max(1, self._context.now_ns - self._last_ns)
        gpu, cores = ((busy.get(n, 0) - self._busy.get(n, 0)) / elapsed for n in ("gpu", "cpu"))
        self._busy = busy
        mode = replace(self._mode, gpu_mhz=self._mode.gpu_mhz * self._clock, cpu_mhz=self._mode.cpu_mhz * self._clock)
        gpu_w = self._power.module_w(self._module, mode, self._fault.use, min(1.0, gpu))
        return gpu_w + cpu_power_w(mode, cores)

    def _slow(self, factor: float) -> None:
        # Others may slow the device down as well: only the own share is exchanged.
        for resource in ("cpu", "gpu"):
            slow_down(self._context, resource, factor / self._factor)
        self._factor = factor
