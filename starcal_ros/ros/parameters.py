# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""ROS parameters declared from options dataclasses."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
import dataclasses
import itertools
from pathlib import Path
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

from starcal_ros import options
from starcal_ros.errors import OptionError
from starcal_ros.pipeline.setup import paths_from
from starcal_ros.record_fields import MOST

# A launch file writes its own parameters to a temporary file of this name: their paths are
# relative to the working folder, as those of the command line.
_OF_LAUNCH = 'launch_params_'


class OptionParameters:
    """
    Options of dataclasses as parameters of a node, checked whenever they are set.

    While ``frozen`` is set, changes are rejected. ``folders`` are those of `folders_of_paths`.
    Raises OptionError if a value from the command line or the parameter file is invalid.
    """

    def __init__(self, node: Node, option_classes: Sequence[type[Any]]) -> None:
        self.frozen = False
        self.folders: dict[tuple[str, object], Path] = {}
        self._node = node
        self._fields = {field.name: field for field in options.option_fields(*option_classes)}
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
        values: dict[str, object] = {
            name: options.check_value(field, self._node.get_parameter(name).value)
            for name, field in self._fields.items()
        }
        for (name, value), folder in self.folders.items():
            if values.get(name) == value:
                values |= paths_from({name: value}, folder)
        return values

    def check_names(self, of_others: Collection[str] = ()) -> None:
        """Raise OptionError for a name given at start that no node has: ROS passes over it."""
        given = getattr(self._node, '_parameter_overrides', {})  # rclpy has no other access to it
        if why := self.why_unknown(name for name in sorted(given) if name not in of_others):
            raise OptionError(why)

    def why_unknown(self, names: Iterable[str]) -> str:
        """One line for the first name that no option has, nor each ROS node; empty if none."""
        unknown = (n for n in names if n not in self._fields and not options.is_of_ros(n))
        return next((options.unknown_option(name, self._fields) for name in unknown), '')

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            field = self._fields.get(parameter.name)
            if field is None:
                continue
            if self.frozen:
                reason = f'{field.name}: in use since configure; clean up to change it'
                return SetParametersResult(successful=False, reason=reason)
            try:
                options.check_value(field, parameter.value)
            except OptionError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def folders_of_paths(arguments: Sequence[str], node: str) -> dict[tuple[str, object], Path]:
    """
    Folder of the parameter file that gives each path, by its option and value.

    ``arguments`` and ``node`` as for `unread_sections`.
    """
    folders: dict[tuple[str, object], Path] = {}
    for file, sections in _parameter_files(arguments):
        if file.name.startswith(_OF_LAUNCH):
            continue
        folder = file.absolute().parent
        for section, body in sections.items():
            values = body.get('ros__parameters') if isinstance(body, dict) else None
            if isinstance(values, dict) and options.section_applies(section, node):
                paths = paths_from(values, folder)
                folders |= {
                    (name, value): folder
                    for name, value in values.items()
                    if isinstance(value, str) and paths[name] != value
                }
    return folders


def unread_sections(arguments: Sequence[str], node: str, executable: str) -> list[str]:
    """
    One warning for each section of a parameter file that rcl passes over without a word.

    Parameters
    ----------
    arguments : sequence of str
        The command line; files follow ``--params-file``.
    node : str
        Name of the node with its namespace.
    executable : str
        Name of the node without a remapping.
    """
    own = {executable, node.rpartition('/')[2]}
    warnings = []
    for file, sections in _parameter_files(arguments):
        meant = [name for name in sections if options.meant_node(name, own)]
        if any(options.section_applies(name, node) for name in meant):
            continue  # the others are those of the same node in other namespaces
        warnings += [
            f'{file}: section {name!r} does not apply to {node}: write /**/{executable}'
            for name in meant
            if '*' not in name.replace('/**/', '')  # rcl has more wildcards
        ]
    return warnings


def _parameter_files(arguments: Sequence[str]) -> list[tuple[Path, dict[str, object]]]:
    """Return the parameter files of a command line with their sections."""
    files = [Path(file) for flag, file in itertools.pairwise(arguments) if flag == '--params-file']
    return [(file, options.parameter_sections(file)) for file in files]


def _as_parameter(default: Any) -> Any:
    return list(default) if isinstance(default, tuple) else default


def _descriptor(field: dataclasses.Field[Any]) -> ParameterDescriptor:
    item, description = field.metadata['item'], field.metadata['description']
    if item.choices:
        description += ': ' + ' | '.join(item.choices)
    # Dynamic typing: check_value accepts 2 for 2.0, as the tool does, and lists may be empty.
    descriptor = ParameterDescriptor(description=description, dynamic_typing=True)
    low, high = item.low, item.high
    if (low, high) == (-MOST, MOST) or isinstance(field.default, (bool, tuple)):
        return descriptor
    if isinstance(field.default, int):
        whole = int(max(low, -(2**63))), int(min(high, 2**63 - 1))
        descriptor.integer_range = [IntegerRange(from_value=whole[0], to_value=whole[1])]
    else:
        bounds = FloatingPointRange(from_value=float(low), to_value=float(high))
        descriptor.floating_point_range = [bounds]
    return descriptor


def _reason(error: Exception) -> str:
    # rclpy prepends a sentence to the reason from the callback.
    text = str(error).replace('\n', ' ')
    return text.rpartition('Reason: ')[2] if 'Reason: ' in text else text
