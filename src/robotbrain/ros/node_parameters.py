"""The parameter functions of ``Node``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from robotbrain.ros.parameter import PARAMETER_SEPARATOR_STRING, Parameter, ParameterType

if TYPE_CHECKING:
    from robotbrain.ros.parameter_set import ParameterSet


class NodeParameters:
    """Declaring, reading, setting and describing parameters; a part of :class:`~robotbrain.ros.node.Node`."""

    _parameters: ParameterSet

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter with its default; an override given at start-up replaces the default.

        Args:
            name: e.g. ``pid.kp``.
            value: the default, or a ``Parameter.Type`` that it must have.
            descriptor: ``rcl_interfaces/msg/ParameterDescriptor``: range, read-only, dynamic typing.
            ignore_override: take the default whatever was given at start-up.

        Raises:
            ParameterAlreadyDeclaredException, InvalidParameterException, InvalidParameterTypeException,
            InvalidParameterValueException: see there.
        """
        bare = value is None and descriptor is None
        return self._parameters.declare(name, value, descriptor, ignore_override, bare=bare)

    def declare_parameters(
        self, namespace: str, parameters: Sequence[tuple[Any, ...]], ignore_override: bool = False
    ) -> list[Parameter]:
        """Declare ``(name, default[, descriptor])`` tuples, names prefixed by ``namespace`` and a dot."""
        prefix = f"{namespace}." if namespace else ""
        declared = []
        for index, row in enumerate(parameters):
            if not 1 <= len(row) <= 3 or not isinstance(row[0], str):
                raise TypeError(f"row {index} of the parameters is {row!r}; it must be (name[, default[, descriptor]])")
            name, value, descriptor = (*row, None, None)[:3]
            declared.append(self.declare_parameter(prefix + name, value, descriptor, ignore_override))
        return declared

    def undeclare_parameter(self, name: str) -> None:
        """Remove a declared parameter; raise ParameterImmutableException when it is read-only."""
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
        """Return a parameter, or the alternative when it is not declared or has no value."""
        known = self._parameters.values.get(name)
        if known is not None and known.type_ != ParameterType.NOT_SET:
            return known
        return alternative_value if alternative_value is not None else Parameter(name)

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Parameter]:
        """Return the parameters whose names begin with ``prefix`` and a dot, by the rest of their names."""
        start = prefix + PARAMETER_SEPARATOR_STRING if prefix else ""
        return {name[len(start) :]: p for name, p in self._parameters.values.items() if name.startswith(start)}

    def get_parameter_type(self, name: str) -> ParameterType:
        """Return the type of a parameter's value."""
        return self._parameters.get_type(name)

    def get_parameter_types(self, names: Sequence[str]) -> list[ParameterType]:
        """Return the types of several parameters' values."""
        return [self._parameters.get_type(name) for name in names]

    def list_parameters(self, prefixes: list[str], depth: int) -> Any:
        """Return names and their prefixes as ``rcl_interfaces/msg/ListParametersResult``.

        Args:
            prefixes: below which to look; all when empty.
            depth: how many levels of names, counted from there; 0 for all.
        """
        if not isinstance(prefixes, list) or not all(isinstance(prefix, str) for prefix in prefixes):
            raise TypeError("The prefixes argument must be a list of str")
        if not isinstance(depth, int):
            raise TypeError("The depth must be instance of type int")
        if depth < 0:
            raise ValueError("The depth must be greater than or equal to zero")
        return self._parameters.listed(prefixes, depth)

    def set_parameters(self, parameter_list: Sequence[Parameter]) -> list[Any]:
        """Set parameters one by one; return a ``SetParametersResult`` for each."""
        return [self._parameters.set([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: Sequence[Parameter]) -> Any:
        """Set all parameters or none; return one ``SetParametersResult``."""
        return self._parameters.set(parameter_list)

    def describe_parameter(self, name: str) -> Any:
        """Return a parameter's ``rcl_interfaces/msg/ParameterDescriptor``."""
        return self._parameters.describe(name)

    def describe_parameters(self, names: Sequence[str]) -> list[Any]:
        """Return the descriptors of several parameters."""
        return [self._parameters.describe(name) for name in names]

    def set_descriptor(self, name: str, descriptor: Any, alternative_value: Any = None) -> Any:
        """Describe a parameter anew and return its value (``rcl_interfaces/msg/ParameterValue``).

        Args:
            name: of a declared parameter.
            descriptor: ``rcl_interfaces/msg/ParameterDescriptor``.
            alternative_value: ``ParameterValue`` that it gets when its value does not fit the descriptor.

        Raises:
            InvalidParameterValueException: neither value fits.
        """
        from robotbrain.ros.parameter import parameter_value_to_python

        alternative = None
        if alternative_value is not None:
            kind = ParameterType(alternative_value.type)
            alternative = Parameter(name, kind, parameter_value_to_python(alternative_value))
        return self._parameters.set_descriptor(name, descriptor, alternative).get_parameter_value()

    def add_pre_set_parameters_callback(self, callback: Callable[[list[Parameter]], list[Parameter]]) -> None:
        """Let ``callback(parameters)`` say what is set instead, before it is checked; not asked when declaring."""
        self._parameters.pre_set.insert(0, callback)

    def add_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Ask ``callback(parameters)`` before each change; its ``SetParametersResult`` decides."""
        if not callable(callback):
            raise TypeError(f"Callback must be callable, got {type(callback)}")
        self._parameters.on_set.insert(0, callback)

    def add_post_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Call ``callback(parameters)`` after each change."""
        if not callable(callback):
            raise TypeError(f"Callback must be callable, got {type(callback)}")
        self._parameters.post_set.insert(0, callback)

    def remove_pre_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Stop asking ``callback``; raise ValueError when it is not there."""
        self._parameters.pre_set.remove(callback)

    def remove_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Stop asking ``callback``; raise ValueError when it is not there."""
        self._parameters.on_set.remove(callback)

    def remove_post_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Stop calling ``callback``; raise ValueError when it is not there."""
        self._parameters.post_set.remove(callback)
