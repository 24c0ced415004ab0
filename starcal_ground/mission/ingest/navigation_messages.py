# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Segments of CCSDS navigation messages, KVN or XML: keywords, epochs and numbers.

Sources: CCSDS 504.0-B-1 and B-2 (AEM 1.0 and 2.0), 502.0-B-1 to B-3 (OEM 1.0 to 3.0), 505.0-B
(XML).  A keyword that the version does not define is refused: it may change the meaning of the
numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
import io
from pathlib import Path
import re
from typing import NamedTuple
from xml.etree import ElementTree

from starcal_ground.mission.ingest.mission_records import text_of
from starcal_ros.errors import IngestError

_VERSION = re.compile(r'CCSDS_([A-Z]+)_VERS\s*=\s*(\S*)')
_ALL = (
    'OBJECT_NAME OBJECT_ID CENTER_NAME TIME_SYSTEM START_TIME USEABLE_START_TIME'
    ' USEABLE_STOP_TIME STOP_TIME INTERPOLATION_DEGREE'
)
_AEM = f'{_ALL} REF_FRAME_A REF_FRAME_B ATTITUDE_TYPE EULER_ROT_SEQ INTERPOLATION_METHOD'
_OEM = frozenset(f'{_ALL} REF_FRAME REF_FRAME_EPOCH INTERPOLATION'.split())
_KEYWORDS = {
    ('AEM', '1.0'): frozenset(f'{_AEM} ATTITUDE_DIR QUATERNION_TYPE RATE_FRAME'.split()),
    ('AEM', '2.0'): frozenset(f'{_AEM} ANGVEL_FRAME'.split()),
    **{('OEM', version): _OEM for version in ('1.0', '2.0', '3.0')},
}


class _Layout(NamedTuple):
    """Sections of a message in KVN, and the element and units of a state in XML."""

    steps: Mapping[tuple[str, str], str]
    end: str
    state: str
    units: Mapping[str, str]


_LAYOUTS = {
    'AEM': _Layout(
        {
            ('header', 'META_START'): 'metadata',
            ('metadata', 'META_STOP'): 'place before DATA_START',
            ('place before DATA_START', 'DATA_START'): 'data',
            ('data', 'DATA_STOP'): 'header',
        },
        'header',
        'attitudeState',
        dict.fromkeys(('Q1', 'Q2', 'Q3', 'QC'), ''),
    ),
    'OEM': _Layout(
        {
            ('header', 'META_START'): 'metadata',
            ('metadata', 'META_STOP'): 'data',
            ('data', 'COVARIANCE_START'): 'covariance',
            ('covariance', 'COVARIANCE_STOP'): 'data',
            ('data', 'META_START'): 'metadata',
        },
        'data',
        'stateVector',
        {'X': 'km', 'Y': 'km', 'Z': 'km', 'X_DOT': 'km/s', 'Y_DOT': 'km/s', 'Z_DOT': 'km/s'},
    ),
}


@dataclass
class Segment:
    """
    Segment of a message.

    ``values`` has one row for each of ``epochs``.  In XML numbers are named: they are Q1, Q2, Q3,
    QC or X, Y, Z, X_DOT, Y_DOT, Z_DOT.  In KVN they are those of the line.
    """

    version: str
    is_xml: bool
    metadata: dict[str, str] = field(default_factory=dict)
    epochs: list[str] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)

    def add_keyword(self, key: str, value: str) -> None:
        """Add a keyword of the metadata; raises ValueError if it is there already."""
        if key in self.metadata:
            raise ValueError(f'keyword {key} is given twice')
        self.metadata[key] = value


def read_segments(path: Path, kind: str) -> list[Segment]:
    """
    Segments of an AEM or OEM, as ``kind`` states.

    Raises IngestError for another message, version or keyword, and for a message that is
    truncated.
    """
    text = text_of(path)
    try:
        if text.lstrip().startswith('<'):
            segments = list(_xml_segments(text, kind))
        else:
            segments = _kvn_segments(text, kind)
        if not segments:
            raise ValueError('no segment')
        for segment in segments:
            _check(segment, kind)
    except ElementTree.ParseError as error:
        raise IngestError(f'{path}: not XML: {error}') from error
    except ValueError as error:
        raise IngestError(f'{path}: not readable as CCSDS {kind}: {error}') from error
    return segments


def _check(segment: Segment, kind: str) -> None:
    keywords = _KEYWORDS.get((kind, segment.version))
    if keywords is None:
        known = ' or '.join(version for name, version in _KEYWORDS if name == kind)
        raise ValueError(f'version {segment.version!r} is not {known}')
    unknown = [key for key in segment.metadata if key not in keywords]
    if unknown:
        raise ValueError(f'version {segment.version} has no keyword {unknown[0]}')


def _kvn_segments(text: str, kind: str) -> list[Segment]:
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    used = ((n, line) for n, line in lines if line and not line.startswith('COMMENT'))
    _, first = next(used, (0, ''))
    found = _VERSION.fullmatch(first)
    if not found or found[1] != kind:
        raise ValueError(f'it begins with {first[:60]!r}, not with CCSDS_{kind}_VERS')
    layout = _LAYOUTS[kind]
    segments: list[Segment] = []
    section = 'header'
    for number, line in used:
        after = layout.steps.get((section, line))
        if after:
            section = after
            if line == 'META_START':
                segments.append(Segment(found[2], is_xml=False))
            continue
        try:
            _kvn_line(section, line, segments)
        except ValueError as error:
            raise ValueError(f'line {number}, in the {section}: {error}') from error
    if section != layout.end:
        raise ValueError(f'it ends in the {section}: truncated?')
    return segments


def _kvn_line(section: str, line: str, segments: list[Segment]) -> None:
    if section == 'data':
        epoch, *numbers = line.split()
        segments[-1].values.append(tuple(map(float, numbers)))
        segments[-1].epochs.append(epoch)
    elif section != 'covariance':
        key, equals, value = line.partition('=')
        if not equals or section not in ('header', 'metadata'):
            raise ValueError(f'{line[:60]!r} is out of place')
        if section == 'metadata':
            segments[-1].add_keyword(key.strip(), value.strip())


def _xml_segments(text: str, kind: str) -> Iterator[Segment]:
    # A few lines of nested entities expand to gigabytes, and an entity can name another file.
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
        raise ValueError('a document type definition is not read; remove it')
    layout = _LAYOUTS[kind]
    version = ''
    messages: list[str] = []  # of a combined instantiation, in their order
    segment = Segment('', is_xml=True)
    for event, element in ElementTree.iterparse(io.StringIO(text), ('start', 'end')):
        tag = element.tag.rpartition('}')[2]
        if event == 'start':
            if element.get('id', '').startswith('CCSDS_'):
                messages.append(tag.upper())
                version = element.get('version', '')
            elif tag == 'segment':
                segment = Segment(version, is_xml=True)
        elif messages[-1:] != [kind]:
            continue
        elif tag == 'metadata':
            for child in element:
                if child.tag != 'COMMENT':
                    segment.add_keyword(child.tag, (child.text or '').strip())
        elif tag == layout.state:
            _add_state(segment, element, layout.units)
            element.clear()
        elif tag == 'segment':
            yield segment
            element.clear()
    if kind not in messages:
        raise ValueError(f'the message is {" and ".join(messages) or "not a CCSDS message"}')


def _add_state(segment: Segment, state: ElementTree.Element, units: Mapping[str, str]) -> None:
    children = {child.tag: child for child in state.iter()}
    missing = [name for name in ('EPOCH', *units) if name not in children]
    if missing:
        raise ValueError(f'a {state.tag} of {list(children)[1]} has no {missing[0]}')
    for name, unit in units.items():
        if children[name].get('units', unit) != unit:
            raise ValueError(f'{name} in {children[name].get("units")}, not in {unit}')
    segment.values.append(tuple(float(children[name].text or '') for name in units))
    segment.epochs.append((children['EPOCH'].text or '').strip())
