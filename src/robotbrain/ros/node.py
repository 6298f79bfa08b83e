"""``Node`` (``rclpy.node``): what a program creates publishers, subscriptions, timers and services with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from robotbrain.ros.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from robotbrain.ros.clock import Clock, ROSClock
from robotbrain.ros.context import SimContext, get_default_context
from robotbrain.ros.exceptions import InvalidHandle
from robotbrain.ros.logging import RcutilsLogger
from robotbrain.ros.names import check_namespace, check_node_name, expand, parse_arguments
from robotbrain.ros.parameter import Parameter, ParameterSet
from robotbrain.ros.qos import QoSProfile, as_profile, qos_profile_services_default
from robotbrain.ros.services import Client, Service
from robotbrain.ros.timer import Timer
from robotbrain.ros.topics import Publisher, Subscription

if TYPE_CHECKING:
    from robotbrain.ros.executors import Executor, Work


class Node:
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
        enable_rosout: accepted; the kit has no ``/rosout``.
        start_parameter_services: accepted; the kit does not start them.

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
        self._name = check_node_name(arguments.node_name or node_name)
        self._namespace = check_namespace(arguments.namespace or namespace)
        self._full_name = f"{'' if self._namespace == '/' else self._namespace}/{self._name}"
        self._remappings = {
            expand(left, self._name, self._namespace): expand(right, self._name, self._namespace)
            for left, right in arguments.remappings.items()
        }
        self._executor: Executor | None = None
        self._parked: list[Work] = []
        self._entities: list[Any] = []
        self._destroyed = False
        self._default_group = MutuallyExclusiveCallbackGroup()
        self._clock = ROSClock(context=self.context)
        self._logger = RcutilsLogger(self._full_name.strip("/").replace("/", "."), self.context)
        overrides = dict(arguments.parameters)
        overrides.update({parameter.name: parameter.value for parameter in parameter_overrides or ()})
        self._parameters = ParameterSet(self, overrides, allow_undeclared_parameters)
        self._parameters.declare("use_sim_time", True, None, False)
        if automatically_declare_parameters_from_overrides:
            for name, value in overrides.items():
                if not self._parameters.has(name):
                    self._parameters.declare(name, value, None, False)
        if any(node.get_fully_qualified_name() == self._full_name for node in self.context.nodes):
            self._logger.warning(f"two nodes are called {self._full_name}; costs and logs cannot tell them apart")
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
        publisher = publisher_class(self, msg_type, self.resolve_topic_name(topic), as_profile(qos_profile))
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
        subscription = Subscription(
            self, msg_type, self.resolve_topic_name(topic), callback, as_profile(qos_profile), callback_group, raw
        )
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
        timer = Timer(self, timer_period_sec, callback, callback_group, autostart)
        self._keep(timer)
        return timer

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

    def destroy_node(self) -> None:
        """Destroy the node and all it created; nothing of it runs any more."""
        if self._destroyed:
            return
        self._destroyed = True
        for entity in list(self._entities):
            entity.destroy()
        if self._executor is not None:
            self._executor.remove_node(self)
        self._parked.clear()
        self.context.nodes.remove(self)

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

    # ------------------------------------------------------------ graph

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        """Return every topic of the graph with its types, sorted by name."""
        return [(name, [topic.typename]) for name, topic in sorted(self.context.topics.items())]

    def get_service_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Return every service of the graph with its types, sorted by name."""
        return [(name, [service.typename]) for name, service in sorted(self.context.services.items())]

    def get_node_names(self) -> list[str]:
        """Return the names of all nodes."""
        return [node.get_name() for node in self.context.nodes]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return names and namespaces of all nodes."""
        return [(node.get_name(), node.get_namespace()) for node in self.context.nodes]

    def count_publishers(self, topic_name: str) -> int:
        """Return the number of publishers on a topic."""
        topic = self.context.topics.get(self.resolve_topic_name(topic_name))
        return len(topic.publishers) if topic else 0

    def count_subscribers(self, topic_name: str) -> int:
        """Return the number of subscriptions to a topic."""
        topic = self.context.topics.get(self.resolve_topic_name(topic_name))
        return len(topic.subscriptions) if topic else 0

    # ------------------------------------------------------------ parameters

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter with its default; an override given at start-up replaces the default."""
        return self._parameters.declare(name, value, descriptor, ignore_override)

    def declare_parameters(
        self, namespace: str, parameters: Sequence[tuple[Any, ...]], ignore_override: bool = False
    ) -> list[Parameter]:
        """Declare ``(name, default[, descriptor])`` tuples, names prefixed by ``namespace`` and a dot."""
        prefix = f"{namespace}." if namespace else ""
        declared = []
        for name, *rest in parameters:
            value, descriptor = [*rest, None, None][:2]
            declared.append(self.declare_parameter(prefix + name, value, descriptor, ignore_override))
        return declared

    def undeclare_parameter(self, name: str) -> None:
        """Remove a declared parameter."""
        self._parameters.undeclare(name)

    def has_parameter(self, name: str) -> bool:
        """Tell whether a parameter is declared."""
        return self._parameters.has(name)

    def get_parameter(self, name: str) -> Parameter:
        """Return a parameter; its value is ``.value``."""
        return self._parameters.get(name)

    def get_parameters(self, names: Sequence[str]) -> list[Parameter]:
        """Return several parameters."""
        return [self._parameters.get(name) for name in names]

    def get_parameter_or(self, name: str, alternative_value: Parameter | None = None) -> Parameter:
        """Return a parameter, or the alternative when it is not declared."""
        if self._parameters.has(name):
            return self._parameters.get(name)
        return alternative_value if alternative_value is not None else Parameter(name)

    def set_parameters(self, parameter_list: Sequence[Parameter]) -> list[Any]:
        """Set parameters one by one; return a ``SetParametersResult`` for each."""
        return [self._parameters.set([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: Sequence[Parameter]) -> Any:
        """Set all parameters or none; return one ``SetParametersResult``."""
        return self._parameters.set(parameter_list)

    def add_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Ask ``callback(parameters)`` before each change; its ``SetParametersResult`` decides."""
        self._parameters.callbacks.insert(0, callback)

    def remove_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Stop asking ``callback``."""
        self._parameters.callbacks.remove(callback)

    def __repr__(self) -> str:
        return f"<Node {self._full_name}>"
