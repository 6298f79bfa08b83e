"""``Node`` (``rclpy.node``): what a program creates publishers, subscriptions, timers and services with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.ros.arguments import parse_arguments
from robotbrain.ros.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from robotbrain.ros.clock import Clock, ROSClock
from robotbrain.ros.context import SimContext, get_default_context
from robotbrain.ros.exceptions import InvalidHandle, NodeNameNonExistentError
from robotbrain.ros.guard_condition import GuardCondition
from robotbrain.ros.logging import RcutilsLogger
from robotbrain.ros.names import check_namespace, check_node_name, expand
from robotbrain.ros.node_graph import NodeGraph
from robotbrain.ros.node_parameters import NodeParameters
from robotbrain.ros.parameter import Parameter
from robotbrain.ros.parameter_service import ParameterService
from robotbrain.ros.parameter_set import ParameterSet
from robotbrain.ros.qos import QoSProfile, as_profile, best_available, qos_profile_services_default
from robotbrain.ros.qos_overriding_options import override_qos
from robotbrain.ros.rate import Rate
from robotbrain.ros.services import Client, Service
from robotbrain.ros.system_topics import (
    SYSTEM_TOPICS,
    add_system_publisher,
    join_system_topics,
    leave_system_topics,
)
from robotbrain.ros.timer import Timer
from robotbrain.ros.topics import Publisher, Subscription

__all__ = ["Node", "NodeNameNonExistentError", "Parameter"]

if TYPE_CHECKING:
    from robotbrain.ros.executors import Executor, Work


class Node(NodeGraph, NodeParameters):
    """A node of the simulated graph.

    Args:
        node_name: letters, digits and ``_``.
        context: the simulation; the default context when omitted.
        cli_args: as of a command line, e.g. ``["--ros-args", "-r", "scan:=/lidar", "-p", "rate:=10"]``.
        namespace: prefix of relative names.
        use_global_arguments: also take the arguments given to ``rclpy.init``.
        parameter_overrides: list of :class:`Parameter` that replace declared defaults.
        allow_undeclared_parameters: read and set parameters without declaring them.
        automatically_declare_parameters_from_overrides: declare every override.
        enable_rosout: tell what is logged on ``/rosout``, when somebody listens.
        rosout_qos_profile: accepted; the kit's ``/rosout`` has the default one.
        start_parameter_services: let other nodes read and set the parameters.
        enable_logger_service: accepted; the kit does not start it.

    Raises:
        NotInitializedException: ``rclpy.init()`` was not called.
        InvalidNodeNameException, InvalidNamespaceException: bad name.
    """

    def __init__(
        self,
        node_name: str,
        *,
        context: SimContext | None = None,
        cli_args: Sequence[str] | None = None,
        namespace: str | None = None,
        use_global_arguments: bool = True,
        enable_rosout: bool = True,
        rosout_qos_profile: QoSProfile | int | None = None,
        start_parameter_services: bool = True,
        parameter_overrides: list[Parameter] | None = None,
        allow_undeclared_parameters: bool = False,
        automatically_declare_parameters_from_overrides: bool = False,
        enable_logger_service: bool = False,
    ) -> None:
        self.context = context if context is not None else get_default_context()
        self.context.require_ok()
        arguments = parse_arguments(cli_args)
        if use_global_arguments:
            arguments = self.context.arguments.merged(arguments)
        check_node_name(node_name)
        self._name = check_node_name(arguments.special(("__node", "__name"), node_name) or node_name)
        self._namespace = check_namespace(arguments.special(("__ns",), node_name) or namespace)
        self._full_name = f"{'' if self._namespace == '/' else self._namespace}/{self._name}"
        self._remappings = arguments.names_of(self._name, self._namespace)
        self._executor: Executor | None = None
        self._parked: list[Work] = []
        self._entities: list[Any] = []
        self._system_publishers: dict[str, Publisher] = {}
        self._rosout = enable_rosout
        self._destroyed = False
        self._default_group = MutuallyExclusiveCallbackGroup()
        self._clock = ROSClock(context=self.context)
        logger_name = self._full_name.strip("/").replace("/", ".")
        self._logger = RcutilsLogger(logger_name, self.context, logger_name)
        overrides = arguments.parameters_of(self._full_name)
        overrides.update({parameter.name: parameter.value for parameter in parameter_overrides or ()})
        self._parameters = ParameterSet(self, overrides, allow_undeclared_parameters)
        join_system_topics(self)
        if automatically_declare_parameters_from_overrides:
            for name, value in overrides.items():
                self._parameters.declare(name, value, None, True)
        if not self._parameters.has("use_sim_time"):
            self._parameters.declare("use_sim_time", True, None, False)
        if any(node.get_fully_qualified_name() == self._full_name for node in self.context.nodes):
            self._logger.warning(f"two nodes are called {self._full_name}; costs and logs cannot tell them apart")
        elif start_parameter_services:
            ParameterService(self)
        self.context.nodes.append(self)
        self.context.default_executor_factory(self).add_node(self)

    # ------------------------------------------------------------ identity

    def get_name(self) -> str:
        """Return the node's name."""
        return self._name

    def get_namespace(self) -> str:
        """Return the namespace, ``/`` for none."""
        return self._namespace

    def get_fully_qualified_name(self) -> str:
        """Return namespace and name, e.g. ``/robot1/planner``."""
        return self._full_name

    def get_logger(self) -> RcutilsLogger:
        """Return the node's logger."""
        return self._logger

    def get_clock(self) -> Clock:
        """Return the node's clock, which reads simulated time."""
        return self._clock

    @property
    def default_callback_group(self) -> CallbackGroup:
        """The mutually exclusive group of entities created without one."""
        return self._default_group

    @property
    def executor(self) -> Executor | None:
        """The executor that runs this node's callbacks."""
        return self._executor

    @executor.setter
    def executor(self, new: Executor | None) -> None:
        if new is None:
            if self._executor is not None:
                self._executor.remove_node(self)
        else:
            new.add_node(self)

    def _set_executor(self, executor: Executor | None) -> None:
        self._executor = executor
        if executor is not None:
            parked, self._parked = self._parked, []
            for work in parked:
                executor.enqueue(work)

    def _enqueue(self, work: Work) -> None:
        if self._executor is not None:
            self._executor.enqueue(work)
        elif not self._destroyed:
            self._parked.append(work)

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """Return the absolute, remapped name of a topic."""
        full = expand(topic, self._name, self._namespace)
        return full if only_expand else self._remappings.get(full, full)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        """Return the absolute, remapped name of a service."""
        full = expand(service, self._name, self._namespace, service=True)
        return full if only_expand else self._remappings.get(full, full)

    # ------------------------------------------------------------ entities

    def _keep(self, entity: Any) -> Any:
        self._entities.append(entity)
        return entity

    def _forget(self, entity: Any) -> None:
        if entity in self._entities:
            self._entities.remove(entity)

    def _check_alive(self) -> None:
        if self._destroyed:
            raise InvalidHandle(f"node {self._full_name} was destroyed and cannot create anything")

    def _qos(self, kind: str, topic: str, qos: QoSProfile, overriding: Any) -> QoSProfile:
        """Return the profile of a new endpoint: a copy, with overrides from parameters and BEST_AVAILABLE resolved."""
        qos = QoSProfile(**qos.__dict__)
        if overriding is not None:
            override_qos(self, kind, topic, qos, overriding)
        known = self.context.topics.get(topic)
        others: list[Any] = []
        if known is not None:
            others = list(known.subscriptions if kind == "publisher" else known.publishers)
        return best_available(qos, [other.qos_profile for other in others], offers=kind == "publisher")

    def create_publisher(
        self,
        msg_type: Any,
        topic: str,
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        publisher_class: type[Publisher] = Publisher,
    ) -> Publisher:
        """Create a publisher; ``qos_profile`` may be an integer depth."""
        self._check_alive()
        name, qos = self.resolve_topic_name(topic), as_profile(qos_profile)
        qos = self._qos("publisher", name, qos, qos_overriding_options)
        publisher = publisher_class(self, msg_type, name, qos, callback_group, event_callbacks)
        self._keep(publisher)
        return publisher

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[[Any], Any],
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        raw: bool = False,
    ) -> Subscription:
        """Create a subscription; ``raw`` gives the callback CDR bytes instead of a message."""
        self._check_alive()
        if callback is None:
            raise InputError(
                f"callback of a subscription to {topic}", given=None, expected="a function", fix="Pass it without ()."
            )
        name, qos = self.resolve_topic_name(topic), as_profile(qos_profile)
        qos = self._qos("subscription", name, qos, qos_overriding_options)
        if name in SYSTEM_TOPICS:
            for node in self.context.nodes:
                add_system_publisher(node, name)
        subscription = Subscription(self, msg_type, name, callback, qos, callback_group, raw, event_callbacks)
        self._keep(subscription)
        return subscription

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[[], Any],
        callback_group: CallbackGroup | None = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        """Create a timer; its first call is one period from now."""
        self._check_alive()
        timer = Timer(self, timer_period_sec, callback, callback_group, autostart, clock)
        self._keep(timer)
        return timer

    def create_rate(self, frequency: float, clock: Clock | None = None) -> Rate:
        """Create a rate of ``frequency`` Hz, for loops outside callbacks.

        Raises:
            ValueError: not a number > 0.
        """
        if not frequency > 0:
            raise ValueError("frequency must be > 0")
        timer = self.create_timer(1 / frequency, lambda: None, ReentrantCallbackGroup(), clock)
        return Rate(timer)

    def create_guard_condition(
        self, callback: Callable[[], Any], callback_group: CallbackGroup | None = None
    ) -> GuardCondition:
        """Create a guard condition: ``callback`` runs after each ``trigger()``."""
        self._check_alive()
        guard = GuardCondition(self, callback, callback_group)
        self._keep(guard)
        return guard

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Service:
        """Create a service; ``callback(request, response)`` returns the response."""
        self._check_alive()
        name = self.resolve_service_name(srv_name)
        service = Service(self, srv_type, name, callback, as_profile(qos_profile), callback_group)
        self._keep(service)
        return service

    def create_client(
        self,
        srv_type: Any,
        srv_name: str,
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Client:
        """Create a client of a service."""
        self._check_alive()
        name = self.resolve_service_name(srv_name)
        client = Client(self, srv_type, name, as_profile(qos_profile), callback_group)
        self._keep(client)
        return client

    def _destroy(self, entity: Any) -> bool:
        known = entity in self._entities
        if known:
            entity.destroy()
        return known

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Destroy a publisher; return False if it is not one of this node."""
        return self._destroy(publisher)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription; return False if it is not one of this node."""
        return self._destroy(subscription)

    def destroy_timer(self, timer: Timer) -> bool:
        """Destroy a timer; return False if it is not one of this node."""
        return self._destroy(timer)

    def destroy_service(self, service: Service) -> bool:
        """Destroy a service; return False if it is not one of this node."""
        return self._destroy(service)

    def destroy_client(self, client: Client) -> bool:
        """Destroy a client; return False if it is not one of this node."""
        return self._destroy(client)

    def destroy_guard_condition(self, guard: GuardCondition) -> bool:
        """Destroy a guard condition; return False if it is not one of this node."""
        return self._destroy(guard)

    def destroy_rate(self, rate: Rate) -> bool:
        """Destroy a rate; return False if it is not one of this node."""
        known = rate._timer in self._entities
        rate.destroy()
        return known

    def destroy_node(self) -> None:
        """Destroy the node and all it created; nothing of it runs any more."""
        if self._destroyed:
            return
        self._destroyed = True
        for entity in list(self._entities):
            entity.destroy()
        leave_system_topics(self)
        if self._executor is not None:
            self._executor.remove_node(self)
        self._parked.clear()
        self.context.nodes.remove(self)

    def _all_parts(self) -> list[Any]:
        """Return all publishers, subscriptions, services and clients, also those that actions are made of."""
        parts = list(self._system_publishers.values())
        for entity in self._entities:
            parts += getattr(entity, "parts", (entity,))
        return parts

    @property
    def guards(self) -> list[GuardCondition]:
        """Guard conditions of this node."""
        return [entity for entity in self._entities if isinstance(entity, GuardCondition)]

    @property
    def publishers(self) -> list[Publisher]:
        """Publishers of this node."""
        return [entity for entity in self._entities if isinstance(entity, Publisher)]

    @property
    def subscriptions(self) -> list[Subscription]:
        """Subscriptions of this node."""
        return [entity for entity in self._entities if isinstance(entity, Subscription)]

    @property
    def timers(self) -> list[Timer]:
        """Timers of this node."""
        return [entity for entity in self._entities if isinstance(entity, Timer)]

    @property
    def services(self) -> list[Service]:
        """Services of this node."""
        return [entity for entity in self._entities if isinstance(entity, Service)]

    @property
    def clients(self) -> list[Client]:
        """Clients of this node."""
        return [entity for entity in self._entities if isinstance(entity, Client)]

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.destroy_node()

    def __repr__(self) -> str:
        return f"<Node {self._full_name}>"
