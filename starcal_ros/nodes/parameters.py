"""ROS parameters declared from options dataclasses."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import sys
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterValueException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from starcal_ros.errors import OptionError
from starcal_ros.options import check_value


class OptionParameters:
    """
    Options of dataclasses as parameters of a node, checked whenever they are set.

    While ``frozen`` is set, changes are rejected.

    Raises
    ------
    OptionError
        If a value from the command line or the parameter file is invalid.
    """

    def __init__(self, node: Node, option_classes: Sequence[type[Any]]) -> None:
        self.frozen = False
        self.classes = tuple(option_classes)
        self._node = node
        self._fields = {f.name: f for cls in option_classes for f in dataclasses.fields(cls)}
        node.add_on_set_parameters_callback(self._on_set)
        for field in self._fields.values():
            try:
                node.declare_parameter(
                    field.name, _as_parameter(field.default), _descriptor(field)
                )
            except InvalidParameterValueException as error:
                raise OptionError(_reason(error)) from error
            except ParameterException as error:
                raise OptionError(f'{field.name}: {_reason(error)}') from error

    def values(self) -> dict[str, object]:
        """Return all options by name, in the types of the dataclasses."""
        return {
            name: check_value(field, self._node.get_parameter(name).value)
            for name, field in self._fields.items()
        }

    def unknown(self) -> list[str]:
        """Return the parameters given at start that match no option; ROS ignores them silently."""
        given = getattr(self._node, '_parameter_overrides', {})  # no public API
        return sorted(
            name
            for name in given
            if name not in self._fields and name != 'use_sim_time' and '.' not in name
        )

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            field = self._fields.get(parameter.name)
            if field is None:
                continue
            if self.frozen:
                reason = f'{field.name}: in use since configure; clean up to change it'
                return SetParametersResult(successful=False, reason=reason)
            try:
                check_value(field, parameter.value)
            except OptionError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def _as_parameter(default: Any) -> Any:
    return list(default) if isinstance(default, tuple) else default


def _descriptor(field: dataclasses.Field[Any]) -> ParameterDescriptor:
    meta = field.metadata
    description = meta['description']
    if meta['choices']:
        description += ': ' + ' | '.join(meta['choices'])
    # Dynamic typing: check_value accepts 2 for 2.0, as the tool does, and lists may be empty.
    descriptor = ParameterDescriptor(description=description, dynamic_typing=True)
    low, high = meta['low'], meta['high']
    if (low is None and high is None) or isinstance(field.default, (bool, tuple)):
        return descriptor
    if isinstance(field.default, int):
        bounds = IntegerRange(
            from_value=-(2**63) if low is None else int(low),
            to_value=2**63 - 1 if high is None else int(high),
        )
        descriptor.integer_range = [bounds]
    else:
        most = sys.float_info.max
        bounds = FloatingPointRange(
            from_value=-most if low is None else float(low),
            to_value=most if high is None else float(high),
        )
        descriptor.floating_point_range = [bounds]
    return descriptor


def _reason(error: Exception) -> str:
    # rclpy prepends a sentence to the reason from the callback.
    text = str(error).replace('\n', ' ')
    return text.rpartition('Reason: ')[2] if 'Reason: ' in text else text
