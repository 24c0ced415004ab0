# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Options: dataclass fields with a description, a unit and a range; reading of parameter files.

Each stage has a frozen options dataclass beside the function that it tunes.  ROS parameters, the
parameter file and the documentation are generated from the fields made with `option`.  The tool
reads them from a parameter file, a node declares them as parameters
(`ros.parameters.OptionParameters`); both give their values to `pipeline.setup.load_setup`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import dataclasses
import difflib
import os
from pathlib import Path
from typing import Any, TypeVar

from starcal_ros.errors import errors_as, OptionError
from starcal_ros.record_fields import FieldType, MOST, nearest, read_value
from starcal_ros.untrusted import PARAMETER_BYTES, read_text, shown, yaml_value

OptionValue = bool | int | float | str | tuple[float, ...] | tuple[str, ...]
OptionsT = TypeVar('OptionsT')
_MOST_CHARACTERS = 4096  # Linux has no longer path
_MOST_ITEMS = 100  # the longest list in use has 22 numbers
_LONGEST_NAME = 100
_LONGEST_SECTION = 255  # ROS allows no longer name of a topic or node
_ALMOST = 0.85  # similarity of names from which one is taken for the other, misspelt


def option(
    default: OptionValue,
    description: str,
    *,
    low: float = -MOST,
    high: float = MOST,
    choices: tuple[str, ...] = (),
    length: int | None = None,
    basic: bool = False,
    is_path: bool = False,
) -> Any:
    """
    Dataclass field with the content of a ROS parameter descriptor.

    ``low`` and ``high`` are inclusive; like ``choices`` they apply to each element of a list.
    ``basic`` marks the few options that most cameras need; the others are advanced.  ``is_path``
    marks a path, in which ``~`` stands for a home folder.
    """
    kind = item = FieldType(
        type(default[0] if isinstance(default, tuple) else default),
        low=low,
        high=high,
        is_finite=True,
        choices=choices,
        most_characters=_MOST_CHARACTERS,
    )
    if isinstance(default, tuple):
        kind = FieldType(
            tuple,
            item=item,
            dimensions=(length or '',),
            most_items=_MOST_ITEMS,
            are_different=bool(choices),
        )
    metadata = {'description': description, 'kind': kind, 'item': item, 'basic': basic}
    return dataclasses.field(default=default, metadata={**metadata, 'is_path': is_path})


def check_value(field: dataclasses.Field[Any], value: object) -> OptionValue:
    """Value in the type of its option; raises OptionError with what is allowed."""
    try:
        checked: OptionValue = read_value(field.metadata['kind'], value, field.name, {})
    except ValueError as error:
        raise OptionError(str(error)) from error
    return with_home(field.name, str(checked)) if field.metadata['is_path'] else checked


def with_home(name: str, path: str) -> str:
    """The path of an option with ``~`` expanded; OptionError for a user without a home folder."""
    expanded = os.path.expanduser(path)
    if expanded.startswith('~'):
        user = path.partition('/')[0]
        raise OptionError(f'{name}: {shown(path)}: no home folder of {user}; give the whole path')
    return expanded


def is_of_ros(name: str) -> bool:
    """True if a parameter of a ``ros2 param dump`` is one that every ROS node has."""
    return '.' in name or name in (
        'use_sim_time',
        'start_type_description_service',
        'qos_overrides',
    )


def unknown_option(name: str, known: Iterable[str]) -> str:
    """Return one line for an unknown name, with a similar name if there is one."""
    said = name if name.isidentifier() and len(name) < _LONGEST_NAME else shown(name)
    return f'{said}: no such parameter{nearest(name, known)}'


def option_fields(*kinds: type[Any]) -> list[dataclasses.Field[Any]]:
    """Fields made with `option`; the others are constants in flight, which studies vary."""
    return [f for kind in kinds for f in dataclasses.fields(kind) if 'description' in f.metadata]


def names_of(*option_classes: type[Any]) -> set[str]:
    """Option names of the given dataclasses."""
    return {field.name for field in option_fields(*option_classes)}


def from_mapping(cls: type[OptionsT], values: Mapping[str, object]) -> OptionsT:
    """Options from the entries of a mapping that match the fields; raises OptionError."""
    given = [field for field in option_fields(cls) if field.name in values]
    return cls(**{field.name: check_value(field, values[field.name]) for field in given})


def parameter_sections(path: Path) -> dict[str, object]:
    """
    Content of a ROS 2 parameter file by section: the full name of a node, or a pattern of it.

    Raises OptionError if the file cannot be read or is not a ROS parameter file.
    """
    with errors_as(OptionError, path):
        content = yaml_value(read_text(path, PARAMETER_BYTES))
    if not isinstance(content, dict):
        raise OptionError(f'{path}: not a ROS parameter file (no node sections)')
    sections = _flat(content, '')
    for name in sections:
        if len(name) > _LONGEST_SECTION:
            raise OptionError(f'{path}: section {shown(name)} is too long for a name')
    return sections


def _flat(content: Mapping[str, object], namespace: str) -> dict[str, object]:
    """Sections of a file; ROS lets the namespaces of a node enclose it, level by level."""
    sections: dict[str, object] = {}
    for key, body in content.items():
        name = f'{namespace}/{key}' if namespace else key
        inside = body.values() if isinstance(body, dict) and 'ros__parameters' not in body else ()
        if inside and all(isinstance(section, dict) for section in inside):
            sections |= _flat(body, name)  # type: ignore[arg-type]
        else:
            sections[name] = body
    return sections


def section_applies(section: str, node: str) -> bool:
    """True if a section is ``/**``, ``/**/NODE`` or the name of a node ``/namespace/NODE``."""
    name = node.lstrip('/')
    return section.lstrip('/') in ('**', name, f'**/{name.rpartition("/")[2]}')


def meant_node(section: str, nodes: Iterable[str]) -> str:
    """The one of the nodes that a section names, or almost names; empty: none of them."""
    last = section.rpartition('/')[2][:_LONGEST_NAME]
    return next(iter(difflib.get_close_matches(last, nodes, 1, _ALMOST)), '')
