# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The metadata.yaml of a bag folder, as rosbag2 reads it (version 9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import yaml

from starcal_ros.bag.typestore import typestore


@dataclass(frozen=True)
class FileSpan:
    """A file of a bag: name, stamps of its first and last message, number of messages."""

    name: str
    first_ns: int
    last_ns: int
    messages: int


@dataclass(frozen=True)
class TopicSummary:
    """A topic of a bag; ``latched``: offered as transient local."""

    name: str
    type_name: str
    latched: bool
    messages: int


def metadata_text(files: Sequence[FileSpan], topics: Sequence[TopicSummary]) -> str:
    """Return the content of the metadata.yaml of at least one file."""
    first_ns, last_ns = min(file.first_ns for file in files), max(file.last_ns for file in files)
    whole = FileSpan('', first_ns, last_ns, sum(file.messages for file in files))
    topic_list = [
        {
            'topic_metadata': {
                'name': topic.name,
                'type': topic.type_name,
                'serialization_format': 'cdr',
                'offered_qos_profiles': [qos_profile(topic.latched)],
                'type_description_hash': typestore().hash_rihs01(topic.type_name),
            },
            'message_count': topic.messages,
        }
        for topic in topics
    ]
    information = {
        'version': 9,
        'storage_identifier': 'mcap',
        'relative_file_paths': [file.name for file in files],
        **_span(whole),
        'topics_with_message_count': topic_list,
        'compression_format': '',
        'compression_mode': '',
        'files': [{'path': file.name, **_span(file)} for file in files],
        'custom_data': None,
        'ros_distro': 'jazzy',
    }
    return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=True)


def _span(file: FileSpan) -> dict[str, object]:
    return {
        'starting_time': {'nanoseconds_since_epoch': file.first_ns},
        'duration': {'nanoseconds': max(file.last_ns - file.first_ns, 0)},
        'message_count': file.messages,
    }


def qos_profile(latched: bool) -> dict[str, object]:
    """Return the QoS in the notation of rosbag2: reliable, and transient local if latched."""

    def forever() -> dict[str, int]:
        return {'sec': 9223372036, 'nsec': 854775807}

    return {
        'history': 'keep_last',
        'depth': 1 if latched else 10,
        'reliability': 'reliable',
        'durability': 'transient_local' if latched else 'volatile',
        'deadline': forever(),
        'lifespan': forever(),
        'liveliness': 'automatic',
        'liveliness_lease_duration': forever(),
        'avoid_ros_namespace_conventions': False,
    }
