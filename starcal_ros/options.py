# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Options: dataclass fields with a description, a unit and a range; reading of parameter files.

Each stage has a frozen options dataclass beside the function that it tunes.  ROS parameters, the
parameter file and the documentation are generated from the fields made with `option`.
"""

from __future__ import annotations

import array
from collections.abc import Iterable, Mapping
import dataclasses
import difflib
import math
from pathlib import Path
from typing import Any, TypeVar

from starcal_ros.errors import OptionError
from starcal_ros.untrusted import check_text, PARAMETER_BYTES, read_text, shown, yaml_value

OptionValue = bool | int | float | str | tuple[float, ...] | tuple[str, ...]
OptionsT = TypeVar('OptionsT')
_INT64 = 2**63
_MOST_CHARACTERS = 4096  # of a text: the longest path of Linux
_MOST_ITEMS = 100  # of a list; the longest in use has 22 numbers
_LONGEST_NAME = 100
_LONGEST_SECTION = 255  # of a topic or node with its namespace, by ROS
_ALMOST = 0.85  # similarity of names from which one is taken for the other, misspelt


def option(
    default: OptionValue,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    length: int | None = None,
) -> Any:
    """
    Dataclass field with the content of a ROS parameter descriptor.

    ``low`` and ``high`` are inclusive; like ``choices`` they apply to each element of a list.
    """
    return dataclasses.field(
        default=default,
        metadata={
            'description': description,
            'low': low,
            'high': high,
            'choices': choices,
            'length': length,
        },
    )


def check_value(field: dataclasses.Field[Any], value: object) -> OptionValue:
    """
    Value converted to the type of the field.

    Raises
    ------
    OptionError
        With the option, the value and the expected type or range.
    """
    default, meta = field.default, field.metadata
    if isinstance(value, array.array):  # a list, as rclpy hands it over
        value = value.tolist()

    def refuse(expected: str) -> OptionError:
        return OptionError(f'{field.name}: {shown(value)} is not {expected}')

    def number(item: object) -> float:
        if isinstance(item, bool) or not isinstance(item, (int, float)):
            raise refuse('a number')
        if isinstance(item, int) and not -_INT64 <= item < _INT64:
            raise refuse('within 64 bit')
        if not math.isfinite(item):
            raise refuse('finite')
        low, high = meta['low'], meta['high']
        if (low is not None and item < low) or (high is not None and item > high):
            raise refuse(f'within {low} to {high}')
        return item

    def text(item: object) -> str:
        if not isinstance(item, str):
            raise refuse('a string')
        try:
            check_text(item)
        except ValueError as error:
            raise OptionError(f'{field.name}: {error}') from error
        if len(item) > _MOST_CHARACTERS:
            raise refuse(f'a text of at most {_MOST_CHARACTERS} characters')
        if meta['choices'] and item not in meta['choices']:
            raise refuse('one of ' + ', '.join(meta['choices']) + nearest(item, meta['choices']))
        return item

    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise refuse('true or false')
        return value
    if isinstance(default, int):
        whole = number(value)
        if whole != int(whole):
            raise refuse('an integer')
        return int(whole)
    if isinstance(default, float):
        return float(number(value))
    if isinstance(default, str):
        return text(value)
    if isinstance(value, (str, bytes)) or not hasattr(value, '__iter__'):
        raise refuse('a list')
    items = list(value)
    if len(items) > _MOST_ITEMS:
        raise OptionError(f'{field.name}: {len(items)} values, at most {_MOST_ITEMS} are read')
    if meta['length'] is not None and len(items) != meta['length']:
        raise refuse(f'a list of {meta["length"]} values')
    of_text = meta['choices'] or (isinstance(default, tuple) and isinstance(default[0], str))
    if of_text:
        texts = tuple(text(item) for item in items)
        if meta['choices'] and len(set(texts)) < len(texts):
            twice = next(item for item in texts if texts.count(item) > 1)
            raise OptionError(f'{field.name}: {twice} stands twice')
        return texts
    return tuple(float(number(item)) for item in items)


def is_of_ros(name: str) -> bool:
    """True if a parameter of a ``ros2 param dump`` is one that every ROS node has."""
    return name in ('use_sim_time', 'start_type_description_service') or '.' in name


_FIELD = 'the field over the detector is always estimated, as large as the stars show it'
_SIGMAS = 'max_map_sigma_px and max_line_of_sight_sigma_arcsec limit all that is not determined'
_PREDICTED = 'max_cross_validated_residual limits how far images are off what the others predict'
REMOVED: Mapping[str, str] = {
    'residual_field': _FIELD,
    'max_field_p_value': _FIELD,
    'max_field_px': 'max_change_px limits the change of the map, the field included',
    'max_parameter_sigma': _SIGMAS,
    'min_singular_value': _SIGMAS,
    'min_independent_images': _SIGMAS,
    'max_star_tracker_excess': 'max_line_of_sight_sigma_arcsec limits what a bad one leads to',
    'max_halves_px': _PREDICTED,
    'max_halves_rotation_arcsec': _PREDICTED,
    'min_halves_p_value': _PREDICTED,
    'min_model_p_value': 'errors outside of the model are estimated, whether significant or not',
    'max_velocity_error_km_s': 'the velocity is estimated with the prior velocity_sigma_m_s, and'
    ' max_held_term_sigma limits how far it is off',
    'max_zero_skew_cost_px': 'zero_skew_cost_px is reported with the calibration',
    'max_step_sigma': 'max_step_px and max_step_rotation_deg limit changes of the lines of sight',
}
"""Options of earlier versions, and what replaces them."""


def unknown_option(name: str, known: Iterable[str]) -> str:
    """Return one line for a name that is no option: what replaced it, or a similar name."""
    said = name if name.isidentifier() and len(name) < _LONGEST_NAME else shown(name)
    if name in REMOVED:
        return f'{said}: not an option any more: {REMOVED[name]}; take it out'
    return f'{said}: no such parameter{nearest(name, known)}'


def nearest(word: str, known: Iterable[str]) -> str:
    """Suggestion for an unknown word, to append to an error message; '' without a close match."""
    # Of a word of a million letters each comparison takes seconds.
    near = difflib.get_close_matches(word[:_LONGEST_NAME], known, 1)
    return f' (did you mean {near[0]}?)' if near else ''


def holds_options(kind: object) -> bool:
    """Return True for a dataclass whose fields were all made with `option`."""
    return (
        isinstance(kind, type)
        and dataclasses.is_dataclass(kind)
        and all('description' in field.metadata for field in dataclasses.fields(kind))
    )


def names_of(*option_classes: type[Any]) -> set[str]:
    """Option names of the given dataclasses."""
    return {f.name for cls in option_classes for f in dataclasses.fields(cls)}


def from_mapping(cls: type[OptionsT], values: Mapping[str, object]) -> OptionsT:
    """
    Options dataclass from the entries of a mapping that match its fields.

    Raises
    ------
    OptionError
        If a value has the wrong type or is out of range.
    """
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    return cls(**{f.name: check_value(f, values[f.name]) for f in fields if f.name in values})


def read_parameter_file(path: Path, nodes: tuple[str, ...]) -> dict[str, object]:
    """
    Parameters of a ROS 2 parameter file that apply to any of the named nodes.

    Sections apply as in ROS: ``/**`` to all, then a node's own name, in any namespace that it is
    given with a wildcard or not at all, later ones winning.

    Raises
    ------
    OptionError
        When the file cannot be read or is not a ROS parameter file, or has a section that seems
        meant for one of the nodes and applies to none.
    """
    values: dict[str, object] = {}
    sections = parameter_sections(path)
    applied = [
        name
        for name in sections
        if any(section_applies(name, f'/{node}') for node in ('', *nodes))
    ]
    named = {meant_node(name, nodes) for name in applied}
    for name in sections:
        meant = meant_node(name, nodes)
        if meant and meant not in named:
            raise OptionError(f'{path}: section {shown(name)} is not read: write /**/{meant}')
    values_only = [name for name, body in sections.items() if not isinstance(body, dict)]
    if not applied and (values_only or 'ros__parameters' in sections):
        above = '/**:' if 'ros__parameters' in sections else '/**: and ros__parameters:'
        raise OptionError(
            f'{path}: parameters in no section of a node: write {above} above them, and indent'
            ' them below'
        )
    if not applied:
        there = ', '.join(sections)
        raise OptionError(
            f'{path}: not a parameter file for this: no section /**, {" or ".join(nodes)}, '
            f'only {there[:80]}'
        )
    for name in applied:
        body = sections[name]
        if not isinstance(body, dict) or not isinstance(body.get('ros__parameters'), dict):
            raise OptionError(f'{path}: section {shown(name)} has no ros__parameters')
        values.update(body['ros__parameters'])
    return values


def parameter_sections(path: Path) -> dict[str, object]:
    """
    Content of a ROS 2 parameter file by section: the full name of a node, or a pattern of it.

    Raises
    ------
    OptionError
        If the file cannot be read or is not a ROS parameter file.
    """
    try:
        content = yaml_value(read_text(path, PARAMETER_BYTES))
    except OSError as error:
        raise OptionError(f'{path}: cannot be read: {error.strerror}') from error
    except ValueError as error:
        raise OptionError(f'{path}: {error}') from error
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
        if inside and all(isinstance(one, dict) for one in inside):
            sections |= _flat(body, name)  # type: ignore[arg-type]
        else:
            sections[name] = body
    return sections


def section_applies(section: str, node: str) -> bool:
    """True if rcl gives a section to a node ``/namespace/name``: * is one part, ** any number."""
    return _parts_match(section.lstrip('/').split('/'), node.lstrip('/').split('/'))


def _parts_match(pattern: list[str], parts: list[str]) -> bool:
    if not pattern or not parts:
        return not parts and all(one == '**' for one in pattern)
    if pattern[0] == '**':
        return _parts_match(pattern[1:], parts) or _parts_match(pattern, parts[1:])
    return pattern[0] in ('*', parts[0]) and _parts_match(pattern[1:], parts[1:])


def meant_node(section: str, nodes: Iterable[str]) -> str:
    """The one of the nodes that a section names, or almost names; empty: none of them."""
    last = section.rpartition('/')[2][:_LONGEST_NAME]
    return next(iter(difflib.get_close_matches(last, nodes, 1, _ALMOST)), '')
