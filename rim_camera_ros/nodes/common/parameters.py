"""Parameters of a node: declared with descriptors, checked together, applied together."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from rim_camera_ros.errors import InputError, RimError, nearest_name
from rim_camera_ros.files import expanded

Values = Mapping[str, Any]

_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


@dataclass(frozen=True)
class Spec:
    """One parameter: its type is that of ``default``; numbers have ``limits``, texts may have ``choices``.

    ``read_only`` parameters are set when the node starts. ``is_path``: paths or names of files, joined by
    ``:``, in which ``~`` is the home folder.
    """

    name: str
    default: bool | int | float | str
    description: str
    limits: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False
    is_path: bool = False

    def read(self, value: Any) -> Any:
        """Return the value of a parameter as it is used, with ``~`` in paths expanded."""
        return expanded(value) if self.is_path else value

    def descriptor(self) -> ParameterDescriptor:
        """Return the descriptor as tools show it."""
        result = ParameterDescriptor(description=self.description, read_only=self.read_only)
        if self.choices:
            result.additional_constraints = "one of: " + ", ".join(self.choices)
        if self.limits is not None:
            low, high = self.limits
            if isinstance(self.default, float):
                result.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
            else:
                result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        return result

    def check(self, value: Any) -> None:
        """Raise `InputError` where the value is not one of the choices or not finite."""
        if self.choices and value not in self.choices:
            raise InputError(
                f"'{value}' is not a choice", place=self.name, remedy="one of: " + ", ".join(self.choices)
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{value} is not finite", place=self.name)


#: What a checked change does once it is accepted.
Apply = Callable[[], None]
Prepare = Callable[[Values, Set[str]], Apply]


class Parameters:
    """The parameters of a node, by name in ``values``.

    After `watch`, each change of one or several parameters goes through ``prepare``. It receives all values
    as they would be and the names of those that change, and returns a function that puts them into effect.
    An error that it raises becomes the reason of the rejection, and the node stays as it is. A parameter that
    is set to its present value changes nothing (``ros2 param load`` sets all of a dump, one after the other),
    except by `renew`. ``also`` may return further values, which change with the given ones.

    Raises `InputError` for a wrong value that was given at the start.
    """

    def __init__(self, node: Node, specs: Sequence[Spec]) -> None:
        self._node = node
        self._specs = {spec.name: spec for spec in specs}
        self.values: dict[str, Any] = {spec.name: spec.read(_declare(node, spec)) for spec in specs}
        self._staged: tuple[dict[str, Any], Apply] | None = None
        self._renewed = ""
        self._prepare: Prepare | None = None
        self._also: Callable[[Values, Values], Values] | None = None

    def extend(self, specs: Sequence[Spec]) -> None:
        """Declare further parameters."""
        for spec in specs:
            self._specs[spec.name] = spec
            self.values[spec.name] = spec.read(_declare(self._node, spec))

    def watch(self, prepare: Prepare, *, also: Callable[[Values, Values], Values] | None = None) -> None:
        """Allow changes from now on. ``also`` receives the values as they would be and the changed ones."""
        self._prepare = prepare
        self._also = also
        self._node.add_pre_set_parameters_callback(self._complete)
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._applied)

    def renew(self, name: str) -> SetParametersResult:
        """Put a parameter into effect again although its value is the same: its file may have changed."""
        self._renewed = name
        try:
            result = self._node.set_parameters_atomically([Parameter(name, value=self.values[name])])
        finally:
            self._renewed = ""
        return result

    def warn_unknown(self, elsewhere: Collection[str] = ()) -> None:
        """Warn of parameters that were given at the start and that the node does not have.

        ``elsewhere``: parameters of other nodes of the process; all nodes receive those given to the process.
        """
        given = getattr(self._node, "_parameter_overrides", {})  # rclpy has no public way to see them
        for name in given:
            if name in elsewhere or name.startswith("qos_overrides."):
                continue
            if not self._node.has_parameter(name):
                remedy = nearest_name(name, {*self._specs, *elsewhere})
                self._node.get_logger().warning(f"no parameter '{name}', it is ignored ({remedy})")

    def _complete(self, parameters: list[Parameter]) -> list[Parameter]:
        """Turn whole numbers into floats where these are expected, and add values that change with others."""
        parameters = [self._converted(parameter) for parameter in parameters]
        given = self._read(parameters)
        if self._also is not None and len(given) == len(parameters):
            for name, value in self._also({**self.values, **given}, self._changed(given)).items():
                if name not in given and value != self.values[name]:
                    parameters.append(Parameter(name, value=value))
        return parameters

    def _read(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        """Return the values of those parameters that belong to this object."""
        known = [
            (self._specs[parameter.name], parameter.value)
            for parameter in parameters
            if parameter.name in self._specs
        ]
        return {spec.name: spec.read(value) for spec, value in known}

    def _changed(self, given: Values) -> dict[str, Any]:
        """Return the given values that differ from the present ones, or for which `renew` was called."""
        return {
            name: value
            for name, value in given.items()
            if name == self._renewed or value != self.values[name]
        }

    def _converted(self, parameter: Parameter) -> Parameter:
        spec = self._specs.get(parameter.name)
        whole = parameter.type_ == Parameter.Type.INTEGER
        if spec is not None and isinstance(spec.default, float) and whole:
            return Parameter(parameter.name, value=float(parameter.value))
        return parameter

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        self._staged = None
        mine = self._read(parameters)
        if not mine or self._prepare is None:
            return SetParametersResult(successful=True)
        try:
            for name, value in mine.items():
                self._specs[name].check(value)
            if changed := self._changed(mine):
                self._staged = (changed, self._prepare({**self.values, **changed}, changed.keys()))
        except RimError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            reason = f"unexpected {type(error).__name__}: {error} (please report this)"
            self._node.get_logger().error(reason)
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _applied(self, parameters: list[Parameter]) -> None:
        if self._staged is None:
            return
        (changed, apply), self._staged = self._staged, None
        self.values.update(changed)
        apply()


def _declare(node: Node, spec: Spec) -> Any:
    """Declare a parameter and return its value; a whole number is accepted where a float is expected."""
    try:
        value = _declared(node, spec)
        spec.check(value)
    except InvalidParameterTypeException:
        raise InputError(
            "has the wrong type", place=spec.name, remedy=f"expected {_WORDS[type(spec.default)]}"
        ) from None
    except ParameterException as error:
        reason = " ".join(str(error).split()).rpartition("Reason: ")[2].removesuffix(f": {spec.name}")
        raise InputError(reason.removesuffix("."), place=spec.name, remedy=spec.description) from None
    return value


def _declared(node: Node, spec: Spec) -> Any:
    default = spec.default
    if isinstance(default, float):
        # an override may be a whole number: the type is checked afterwards
        flexible = ParameterDescriptor(dynamic_typing=True)
        given = node.declare_parameter(spec.name, default, flexible).value
        node.undeclare_parameter(spec.name)
        if isinstance(given, int) and not isinstance(given, bool):
            return node.declare_parameter(
                spec.name, float(given), spec.descriptor(), ignore_override=True
            ).value
    return node.declare_parameter(spec.name, default, spec.descriptor()).value
