# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""ROS parameter files of the nodes, read by the tool."""

from __future__ import annotations

from pathlib import Path

from starcal_ros import options
from starcal_ros.errors import OptionError
from starcal_ros.pipeline.setup import load_setup, paths_from, Setup
from starcal_ros.untrusted import shown

NODES = ('star_observer', 'calibrator')
_OF_CAMERAS = {'image_width', 'camera_matrix', 'cam0'}  # ROS, OpenCV, kalibr


def read_setup(params: Path) -> Setup:
    """
    Setup of a ROS parameter file, which may also set parameters of the nodes.

    Raises as `load_setup`; the message on an option begins with the file.
    """
    values = read_values(params)
    try:
        return load_setup(values)
    except OptionError as error:
        raise OptionError(f'{params}: {error}') from error


def read_values(params: Path) -> dict[str, object]:
    """
    Options of a ROS parameter file by name; relative paths are relative to that file.

    Raises OptionError when it is not a parameter file.
    """
    return paths_from(read_parameter_file(params, NODES), params.parent)


def read_parameter_file(path: Path, nodes: tuple[str, ...]) -> dict[str, object]:
    """
    Parameters of a ROS 2 parameter file that apply to any of the named nodes.

    Sections apply as in ROS, later ones winning: ``/**``, ``/**/NODE`` and ``NODE``; those with
    other wildcards are not read.

    Raises OptionError when the file cannot be read or is not a ROS parameter file, or has a
    section that seems meant for one of the nodes and applies to none.
    """
    values: dict[str, object] = {}
    sections = options.parameter_sections(path)
    applied = [
        name
        for name in sections
        if any(options.section_applies(name, f'/{node}') for node in ('', *nodes))
    ]
    named = {options.meant_node(name, nodes) for name in applied}
    for name in sections:
        meant = options.meant_node(name, nodes)
        if meant and meant not in named:
            raise OptionError(f'{path}: section {shown(name)} is not read: write /**/{meant}')
    of_nodes = {
        name
        for name, body in sections.items()
        if isinstance(body, dict) and 'ros__parameters' in body
    }
    if cameras := (_OF_CAMERAS & {*sections}) - of_nodes:
        raise OptionError(
            f'{path}: a camera file ({min(cameras)}), not a parameter file: give it as'
            f' camera_info_url in one, or --set camera_info_url={path}'
        )
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
