# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Real processes: replay with /clock, and the permissions of each node."""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path
from xml.etree import ElementTree

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import pytest
from vehicle import BOTH, Client, IMAGES, REMAPS, Vehicle  # type: ignore[import-not-found]

from starcal.msg import EnsembleStatus
from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import reader
from starcal_ros.formats.messages.message_codec import stamp_ns
from starcal_ros.records import Image

ROOT = Path(__file__).parents[2]


@pytest.mark.nodes
def test_a_bag_plays_again_by_its_clock(vehicle: Vehicle) -> None:
    """Nodes as in replay.launch.py, with a namespace and /clock; a second pass adds nothing."""
    for name in BOTH:
        ros = ('-r', '__ns:=/cam', '-r', f'__node:={name}', *REMAPS, '--log-level', 'info')
        vehicle.start(name, 'autostart:=true', 'use_sim_time:=true', ros=ros)
    vehicle.until(lambda: vehicle.node.count_subscribers('/cam/observations'))
    status = vehicle.latched(EnsembleStatus, '/cam/ensemble_status')
    health = vehicle.collect(DiagnosticArray, '/diagnostics')
    # Simulated time without a /clock yet: diagnostics come all the same, and warn of it.
    vehicle.until(lambda: len({one.status[0].name for one in health if warns_of_clock(one)}) == 2)
    vehicle.start_player(vehicle.bag, 'loop:=true', 'clock:=true', ros=('-r', '__ns:=/cam'))

    def restarts() -> int:
        told = (one.status[0] for one in health if 'star_observer' in one.status[0].name)
        values = [int(v.value) for s in told for v in s.values if v.key == 'restarts']
        return max(values, default=0)

    vehicle.until(lambda: restarts() >= 1)
    images = len(list(reader.read_images([vehicle.bag], IMAGES)))
    vehicle.until(lambda: status and status[-1].images == images)
    stamps = [raw.log_time_ns for raw in reader.read_raw([vehicle.bag])]

    def is_within_the_bag() -> bool:
        return min(stamps) <= stamp_ns(health[-1].header.stamp) <= max(stamps) + 10**9

    vehicle.until(is_within_the_bag)  # whatever pass: the diagnostics take the time from /clock


def warns_of_clock(message: DiagnosticArray) -> bool:
    status = message.status[0]
    return bool(status.level == b'\x01' and status.message.startswith('no /clock: '))


@pytest.mark.nodes
def test_the_policies_name_what_the_nodes_have(vehicle: Vehicle, tmp_path: Path) -> None:
    """Each security policy allows exactly the topics and services of its node."""
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_image('/image', Image(1, np.zeros((2, 2), np.uint8)), 'camera')
        writer.write_attitude('/attitude', 1, np.array([0, 0, 0, 1.0]), 'icrf')
        writer.write_velocity('/velocity', 1, np.zeros(3), 'icrf')
        writer.write_temperature('/temperature', 1, 20.0, 'camera')
    vehicle.start_player(tmp_path / 'bag', 'clock:=true', 'wait_for_subscribers_s:=100.0')
    for name in BOTH:
        # Nobody may listen to the player, or it plays and ends.
        remaps = ('-r', 'image:=/elsewhere') if name == 'star_observer' else ()
        vehicle.start(name, ros=remaps)
    for name in (*BOTH, 'bag_player'):
        path = ROOT / 'config' / 'security' / f'{name}.policy.xml'
        profile = ElementTree.parse(path).getroot().find('enclaves/enclave/profiles/profile')
        assert profile is not None and profile.get('node') == name and profile.get('ns') == '/'
        allowed = {
            (kind, full_name(name, str(element.text)))
            for group in profile
            for kind in ('publish', 'subscribe', 'reply', 'request')
            if group.get(kind) == 'ALLOW'
            for element in group
        }
        if importlib.util.find_spec('tf2_msgs') is None:
            allowed -= {('publish', '/tf_static'), ('subscribe', '/tf_static')}
        vehicle.until(functools.partial(shows, vehicle, name, allowed))
        assert of_graph(vehicle, name) == allowed, name


def full_name(node: str, name: str) -> str:
    """Name in a policy, resolved for a node in the root namespace."""
    if name.startswith('~/'):
        return f'/{node}/{name[2:]}'
    return name if name.startswith('/') else f'/{name}'


def of_graph(client: Client, name: str) -> set[tuple[str, str]]:
    """Names of the topics and services of a node, by the policy tags."""
    node = client.node
    found = set()
    for kind, ask in (
        ('publish', node.get_publisher_names_and_types_by_node),
        ('subscribe', node.get_subscriber_names_and_types_by_node),
        ('reply', node.get_service_names_and_types_by_node),
        ('request', node.get_client_names_and_types_by_node),
    ):
        found |= {(kind, topic) for topic, _ in ask(name, '/')}
    if ('subscribe', '/elsewhere') in found:
        found = {*found - {('subscribe', '/elsewhere')}, ('subscribe', '/image')}
    return found


def shows(client: Client, name: str, allowed: set[tuple[str, str]]) -> bool:
    """Return True once the graph shows all names that a node may use."""
    return name in client.node.get_node_names() and of_graph(client, name) >= allowed
