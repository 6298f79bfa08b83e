"""The parameters of one node: declaring, checking, setting, and who is asked and told."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from robotbrain.ros.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from robotbrain.ros.messages import message_class
from robotbrain.ros.parameter import Parameter, ParameterType, infer_type
from robotbrain.ros.system_topics import PARAMETER_EVENTS

if TYPE_CHECKING:
    from robotbrain.ros.node import Node

REL_TOL = 1e-6
"""Relative tolerance of comparisons with a floating-point range, as in rclpy."""


class ParameterSet:
    """The declared parameters of a node.

    Attributes:
        pre_set: callbacks that may change what is set; ``on_set``: that may refuse it; ``post_set``: that are told.
        values, descriptors: by name.
    """

    def __init__(self, node: Node, overrides: dict[str, Any], allow_undeclared: bool) -> None:
        self._node, self.overrides, self.allow_undeclared = node, overrides, allow_undeclared
        self.values: dict[str, Parameter] = {}
        self.descriptors: dict[str, Any] = {}
        self.pre_set: list[Callable[[list[Parameter]], list[Parameter]]] = []
        self.on_set: list[Callable[[list[Parameter]], Any]] = []
        self.post_set: list[Callable[[list[Parameter]], Any]] = []

    # ------------------------------------------------------------ declaring

    def declare(
        self, name: Any, value: Any, descriptor: Any, ignore_override: bool, *, bare: bool = False
    ) -> Parameter:
        """Declare one parameter; see ``Node.declare_parameter``. ``bare``: by nothing but its name."""
        if not isinstance(name, str) or not name:
            raise InvalidParameterException(
                "parameter name", given=name, expected="a non-empty string", fix="Example: 'pid.kp'."
            )
        if name in self.values:
            raise ParameterAlreadyDeclaredException(
                f"parameter {name}",
                given="a second declaration",
                expected=f"one per node ({self._node.get_name()})",
                fix="Use set_parameters to change it, or has_parameter to ask.",
            )
        wanted = message_class("rcl_interfaces/msg/ParameterDescriptor")
        if descriptor is None:
            descriptor = wanted(dynamic_typing=bare)
        elif not isinstance(descriptor, wanted):
            raise TypeError(f"the descriptor of {name} is a {type(descriptor).__name__}, not {wanted.__name__}")
        if isinstance(value, ParameterType):
            if value == ParameterType.NOT_SET or descriptor.dynamic_typing:
                raise InvalidParameterValueException(
                    f"parameter {name}",
                    given=value.name,
                    expected="a type that stays",
                    fix="Declare it by a type, or with a descriptor with dynamic_typing=True and a value.",
                )
            descriptor.type, value = int(value), None
        elif not descriptor.dynamic_typing:
            descriptor.type = int(infer_type(value))
            if value is None:
                raise InvalidParameterValueException(
                    f"parameter {name}",
                    given=None,
                    expected="a default value or a type",
                    fix="Write declare_parameter(name, 1.0), declare_parameter(name, Parameter.Type.DOUBLE), "
                    "or give a descriptor with dynamic_typing=True.",
                )
        if name in self.overrides and not ignore_override:
            value = self.overrides[name]
        kind = ParameterType(descriptor.type)
        fits = not descriptor.dynamic_typing and kind >= ParameterType.BYTE_ARRAY and kind.check(value)
        parameter = Parameter(name, kind if fits else None, value)
        result = self._apply([parameter], {name: descriptor}, declaring=True)
        if not result.successful:
            problem: type[ParameterException] = InvalidParameterValueException
            if not descriptor.dynamic_typing and parameter.type_ not in (ParameterType.NOT_SET, kind):
                problem = InvalidParameterTypeException
            raise problem(
                f"parameter {name}", given=value, expected=result.reason, fix="Change the default or what overrides it."
            )
        return self.values[name]

    def undeclare(self, name: str) -> None:
        """Remove a declared parameter."""
        if name not in self.values:
            raise self._not_declared(name)
        if self.descriptors[name].read_only:
            raise ParameterImmutableException(
                f"parameter {name}", given="undeclare_parameter", expected="nothing: it is read-only", fix="Keep it."
            )
        del self.values[name], self.descriptors[name]

    # ------------------------------------------------------------ reading

    def has(self, name: str) -> bool:
        """Tell whether the parameter is declared."""
        return name in self.values

    def get(self, name: str) -> Parameter:
        """Return the parameter; raise when it was not declared or has no value."""
        parameter = self.values.get(name)
        if parameter is None:
            if self.allow_undeclared:
                return Parameter(name)
            raise self._not_declared(name)
        if parameter.type_ == ParameterType.NOT_SET and not self.descriptors[name].dynamic_typing:
            raise ParameterUninitializedException(
                f"parameter {name}", given="no value", expected="a value", fix="Set it or declare a default."
            )
        return parameter

    def get_type(self, name: str) -> ParameterType:
        """Return the type of a parameter's value; NOT_SET of an undeclared one where these are allowed."""
        if name in self.values:
            return self.values[name].type_
        if self.allow_undeclared:
            return ParameterType.NOT_SET
        raise self._not_declared(name)

    def describe(self, name: str) -> Any:
        """Return a parameter's descriptor."""
        if name in self.descriptors:
            return self.descriptors[name]
        if self.allow_undeclared:
            return message_class("rcl_interfaces/msg/ParameterDescriptor")()
        raise self._not_declared(name)

    def set_descriptor(self, name: str, descriptor: Any, alternative: Parameter | None) -> Parameter:
        """Describe a parameter anew; where its value does not fit, it becomes ``alternative``."""
        if name not in self.values:
            if self.allow_undeclared:
                return Parameter(name)
            raise self._not_declared(name)
        if self.descriptors[name].read_only:
            raise ParameterImmutableException(
                f"parameter {name}", given="a new descriptor", expected="nothing: it is read-only", fix="Keep it."
            )
        reason = ""
        for parameter in (self.values[name], alternative):
            if parameter is not None:
                reason = self._refusal(parameter, descriptor, check_read_only=False)
                if not reason:
                    descriptor.name = name
                    self.values[name], self.descriptors[name] = parameter, descriptor
                    return parameter
        raise InvalidParameterValueException(
            f"parameter {name}", given=self.values[name].value, expected=reason, fix="Give an alternative value."
        )

    def listed(self, prefixes: Sequence[str], depth: int) -> Any:
        """Return ``rcl_interfaces/msg/ListParametersResult``; see ``Node.list_parameters``."""
        result: Any = message_class("rcl_interfaces/msg/ListParametersResult")()
        for name in self.values:
            # Depth counts names below the prefix; 0 means all.
            rests = [name] if not prefixes else [name[len(p) + 1 :] for p in prefixes if name.startswith(p + ".")]
            if name in prefixes or any(not depth or rest.count(".") < depth for rest in rests):
                result.names.append(name)
                prefix = name.rpartition(".")[0]
                if prefix and prefix not in result.prefixes:
                    result.prefixes.append(prefix)
        return result

    def _not_declared(self, *names: str) -> ParameterNotDeclaredException:
        return ParameterNotDeclaredException(
            "parameter",
            given=", ".join(map(str, names)),
            expected=f"a declared one of {self._node.get_name()}: {', '.join(self.values)}",
            fix=f"Call declare_parameter({names[0]!r}, default) first.",
        )

    # ------------------------------------------------------------ setting

    def set(self, parameters: Iterable[Any]) -> Any:
        """Set all or none; return ``rcl_interfaces/msg/SetParametersResult``."""
        chosen: list[Any] = list(parameters)
        if self.pre_set:
            chosen = [parameter for callback in self.pre_set for parameter in callback(chosen)]
            if not chosen:
                return _result(False, "parameter list cannot be empty; a pre_set_parameters_callback returned none")
        for parameter in chosen:
            if not isinstance(parameter, Parameter):
                raise TypeError(f"expected a Parameter, got {parameter!r}: write Parameter(name, value=...)")
        unknown = [parameter.name for parameter in chosen if parameter.name not in self.values]
        if unknown and not self.allow_undeclared:
            raise self._not_declared(*unknown)
        return self._apply(chosen, self.descriptors, declaring=False)

    def _apply(self, parameters: list[Parameter], descriptors: dict[str, Any], *, declaring: bool) -> Any:
        for parameter in parameters:
            descriptor = descriptors.get(parameter.name)
            if descriptor is not None:
                reason = self._refusal(parameter, descriptor, check_read_only=not declaring)
                if reason:
                    return _result(False, reason)
        expected: Any = message_class("rcl_interfaces/msg/SetParametersResult")
        for callback in self.on_set:
            result = callback(parameters)
            if not isinstance(result, expected):
                warnings.warn("Callback returned an invalid type, it should return SetParametersResult.", stacklevel=2)
                return _result(False, "Callback returned an invalid type")
            if not result.successful:
                return result
        new: list[Parameter] = []
        changed: list[Parameter] = []
        deleted: list[Parameter] = []
        for parameter in parameters:
            name = parameter.name
            if parameter.type_ == ParameterType.NOT_SET and not declaring:
                deleted.append(parameter)
                self.values.pop(name, None)
                self.descriptors.pop(name, None)
                continue
            if declaring:
                self.descriptors[name] = descriptors[name]
                descriptors[name].name = name
            elif name not in self.descriptors:
                descriptor = message_class("rcl_interfaces/msg/ParameterDescriptor")
                self.descriptors[name] = descriptor(name=name, type=int(parameter.type_), dynamic_typing=True)
            elif self.descriptors[name].dynamic_typing:
                self.descriptors[name].type = int(parameter.type_)
            before = self.values.get(name)
            (new if before is None or before.type_ == ParameterType.NOT_SET else changed).append(parameter)
            self.values[name] = parameter
        self._tell(new, changed, deleted)
        for told in self.post_set:
            told(parameters)
        return _result(True, "")

    def _tell(self, new: list[Parameter], changed: list[Parameter], deleted: list[Parameter]) -> None:
        publisher = self._node._system_publishers.get(PARAMETER_EVENTS)
        if publisher is None or not publisher.matched:
            return  # nobody listens; late subscribers would not get it anyhow
        publisher.publish(
            message_class("rcl_interfaces/msg/ParameterEvent")(
                stamp=self._node.get_clock().now().to_msg(),
                node=self._node.get_fully_qualified_name(),
                new_parameters=[parameter.to_parameter_msg() for parameter in new],
                changed_parameters=[parameter.to_parameter_msg() for parameter in changed],
                deleted_parameters=[parameter.to_parameter_msg() for parameter in deleted],
            )
        )

    def _refusal(self, parameter: Parameter, descriptor: Any, *, check_read_only: bool) -> str:
        """Return why a descriptor forbids a value, or ``""``."""
        name, kind = parameter.name, parameter.type_
        if check_read_only and descriptor.read_only:
            return f"Trying to set a read-only parameter: {name}."
        if descriptor.dynamic_typing:
            pass
        elif kind == ParameterType.NOT_SET:
            return "Static parameter cannot be undeclared" if name in self.values else ""
        elif int(kind) != descriptor.type:
            wanted = ParameterType(descriptor.type)
            if wanted < ParameterType.BYTE_ARRAY or not wanted.check(parameter.value):
                return f"Wrong parameter type, expected '{wanted.name}' got '{kind.name}' (parameter {name})"
        if kind == ParameterType.INTEGER and descriptor.integer_range:
            return _outside(parameter, descriptor.integer_range[0], exact=True)
        if kind == ParameterType.DOUBLE and descriptor.floating_point_range:
            return _outside(parameter, descriptor.floating_point_range[0], exact=False)
        return ""


def _outside(parameter: Parameter, limits: Any, *, exact: bool) -> str:
    """Return why a value is not in a range with steps, or ``""``; both ends are always inside."""
    low, high = sorted((limits.from_value, limits.to_value))
    value, step = parameter.value, limits.step

    def same(first: float, second: float) -> bool:
        return first == second if exact else math.isclose(first, second, rel_tol=REL_TOL)

    if same(value, low) or same(value, high):
        return ""
    told = f"Parameter {parameter.name}: {value} is not"
    if not low < value < high:
        return f"{told} in range: min {low}, max {high}"
    if step and not same(low + round((value - low) / step) * step, value):
        return f"{told} a valid step: min {low}, max {high}, step {step}"
    return ""


def _result(successful: bool, reason: str) -> Any:
    return message_class("rcl_interfaces/msg/SetParametersResult")(successful=successful, reason=reason)
