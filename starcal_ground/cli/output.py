# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Tables and lines that the tool prints for a calibration, a bag and a comparison.

No command replaces an input, or a file that starcal did not write: `check_outputs`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcal_ground.cli.terminal import print_table, print_text, print_verdict
from starcal_ground.outputs import check_outputs
from starcal_ground.products import NOT_CALIBRATED_FILE, PRODUCT_FILES
from starcal_ground.report.thumbnails import THUMBNAILS_FOLDER, thumbnails_in
from starcal_ros.arrays import Floats
from starcal_ros.camera import INTRINSIC_NAMES
from starcal_ros.constants import ARCSECOND_RAD, utc_text
from starcal_ros.errors import OptionError
from starcal_ros.files import same_as_one_of
from starcal_ros.formats.bag import reader
from starcal_ros.text import p_value_text, significant, to_sigma


def check_folder(folder: Path, bags: Sequence[Path], files: Sequence[Path]) -> None:
    """
    `check_outputs` of the products of a calibration, which do not become part of a bag either.

    Raises OptionError or ProductError naming the folder or the file.
    """
    bag_files = reader.files_of_bags(bags)
    if same_as_one_of(folder, [file.parent for file in bag_files]):
        raise OptionError(f'{folder}: holds the bag that is read; choose another folder (-o)')
    products = [folder / name for name in (*PRODUCT_FILES, NOT_CALIBRATED_FILE)]
    pictures = thumbnails_in(folder / THUMBNAILS_FOLDER)
    check_outputs((*products, *pictures), (*bag_files, *files))


def check_file(output: Path, inputs: Sequence[Path]) -> None:
    """`check_outputs` of one file, which is no product beside an input either."""
    beside = [file.with_name(name) for file in inputs for name in PRODUCT_FILES]
    check_outputs([output], [*inputs, *beside])


if TYPE_CHECKING:
    from starcal_ground.comparison import Comparison, DifferenceMap
    from starcal_ground.planning.inspect import Inspection, TopicContent
    from starcal_ros.records import Calibration, CameraGeometry


def print_calibration(calibration: Calibration, prior: CameraGeometry) -> None:
    """Print parameters, statistics and verdict; changes are relative to the prior."""
    from starcal_ros.assessment.agreement import alignment_difference_rad
    from starcal_ros.estimation import temperature
    from starcal_ros.estimation.problem import alignment_summary

    camera, sigma = calibration.geometry.camera, calibration.sigma
    changes: Floats = np.full(len(camera.parameters), np.nan)
    if prior.camera.model == camera.model:  # those of another lens model are no start of these
        changes = camera.parameters - prior.camera.parameters
    rows = []
    for k, name in enumerate(camera.parameter_names):
        value, change = camera.parameters[k], changes[k]
        free = name in calibration.estimated
        rows.append(
            (
                name,
                to_sigma(value, sigma[k]),
                'px' if name in INTRINSIC_NAMES else '',
                significant(sigma[k], 2) if free else 'held',
                to_sigma(change, sigma[k], '+') if np.isfinite(change) else '',
                _sigmas(change, sigma[k]) if free and np.isfinite(change) else '',
            )
        )
    angles = alignment_difference_rad(calibration.geometry, prior) / ARCSECOND_RAD
    for axis, angle, error in zip('xyz', angles, sigma[-3:] / ARCSECOND_RAD, strict=True):
        if not calibration.has_alignment:
            break
        rows.append(
            (
                f'alignment {axis}', '', 'arcsec', f'{error:.2f}', f'{angle:+.2f}',
                _sigmas(angle, error),
            )
        )  # fmt: skip
    print_table(('parameter', 'value', 'unit', '1-sigma', 'from prior', 'in sigmas'), rows)
    _print_budget(calibration)
    quaternion = calibration.geometry.star_tracker_from_camera_xyzw
    aligned = np.array2string(quaternion, precision=9, separator=', ')
    if not calibration.has_alignment:
        aligned = 'none: attitudes from the stars, the camera alone'
    print_text(f'alignment xyzw  {aligned}')
    print_text(f'images          {calibration.images_used} used, refused: ', end='')
    print_text(_counted(calibration.images_refused))
    print_text(
        f'stars           {calibration.stars_used} used, {calibration.stars_rejected} rejected'
    )
    print_text(f'residual        {calibration.residual_rms_px:.4f} px rms per axis')
    print_text(f'method          {calibration.method}')
    print_text(f'solver          {calibration.iterations} iterations, {calibration.termination}')
    if calibration.temperature is not None:
        print_text(f'temperature     {temperature.summary(calibration.temperature)}')
    for one in calibration.star_trackers:
        print_text(f'star tracker    {alignment_summary(one)}')
    if calibration.accepted:
        print_verdict(True, 'verdict         accepted')
    else:
        print_verdict(False, f'verdict         refused: {"; ".join(calibration.reasons)}')


def _print_budget(calibration: Calibration) -> None:
    from starcal_ros.records import parts_that_matter

    parts = parts_that_matter(calibration.sigma_budget)
    columns = 4 if calibration.has_alignment else 3
    rows = [
        (
            part.cause,
            part.assumption,
            *(
                f'{significant(one, 3, least=0.001)}"'
                for one in (part.map_arcsec, part.pointing_arcsec)
            ),
        )
        for part in parts
    ]
    if rows:
        header = ('1-sigma of lines of sight', '', 'camera alone', 'with alignment')
        print_table(header[:columns], [row[:columns] for row in rows], left=2)


def print_inspection(inspection: Inspection) -> None:
    """Print topics, images, attitudes and refused images."""
    print_table(
        ('topic', 'type', 'messages', 'rate', 'longest gap'),
        [
            (
                topic.name,
                topic.type_name.replace('/msg/', '/'),
                str(topic.count),
                f'{significant(topic.rate_hz, 3)} Hz' if topic.rate_hz else '',
                f'{significant(topic.longest_gap_s, 3)} s' if topic.count > 1 else '',
            )
            for topic in inspection.topics
        ],
        left=2,
    )
    for topic in inspection.topics:
        print_text(f'{topic.name}: {"; ".join(_topic_notes(topic))}')
    for text in inspection.damage:
        print_text(f'damage: {text}')
    if inspection.images:
        _print_images(inspection)
    if inspection.status is not None:
        print_table(
            ('predicted', '1-sigma'),
            [
                (name, _predicted(name, value))
                for name, value in zip(
                    inspection.status.parameter_names,
                    inspection.status.predicted_sigma,
                    strict=True,
                )
            ],
        )
    if inspection.problems:
        print_verdict(False, 'cannot be calibrated: ' + '; '.join(inspection.problems))
    elif inspection.by_stars:
        print_verdict(True, 'no problems found so far; the camera alone, without attitudes')
    elif inspection.measured:
        print_verdict(True, 'can be calibrated')
    else:
        print_verdict(True, 'no problems found so far; use --params to measure the stars too')


def _print_images(inspection: Inspection) -> None:
    bad = sum(refused.count for refused in inspection.refused)
    chosen = inspection.chosen
    assert chosen is not None  # images come from a chosen topic
    attitudes = ', '.join(filter(None, (chosen.attitude, *chosen.more_attitudes)))
    print_text(
        f'{inspection.images - bad} of {inspection.images} images of '
        f'{chosen.image or chosen.observations} can be used'
        + (f', with the attitudes of {attitudes}' if attitudes else '')
    )
    if math.isfinite(inspection.longest_attitude_gap_s):
        gap_s = significant(inspection.longest_attitude_gap_s, 3)
        print_text(f'longest attitude gap around an image: {gap_s} s')
    if inspection.refused:
        print_table(
            ('refused', 'images', 'meaning', 'first'),
            [
                (r.reason, str(r.count), r.meaning, f'{_clock(r.first_ns)}: {r.detail}')
                for r in inspection.refused
            ],
            left=4,
        )
    if inspection.stars_per_image:
        stars = inspection.stars_per_image
        print_text(
            f'stars per image: {min(stars)} to {max(stars)}, {sum(stars)} in total; '
            f'refused: {_counted(inspection.refused_stars)}'
        )


def print_comparison(comparison: Comparison) -> None:
    """Print the differences of parameters, alignment and lines of sight."""
    a, b = (c.geometry.camera for c in (comparison.a, comparison.b))
    of_a = dict(zip(a.parameter_names, a.parameters, strict=True))
    difference, sigma = comparison.difference, comparison.sigma
    rows = [
        (
            name,
            to_sigma(of_a[name], sigma[k]) if name in of_a else '',
            to_sigma(b.parameters[k], sigma[k]),
            to_sigma(difference[k], sigma[k], '+'),
            significant(sigma[k], 2) if sigma[k] else 'held',
            _sigmas(difference[k], sigma[k]),
        )
        for k, name in enumerate(b.parameter_names)
    ]
    arcsec, sigma_arcsec = difference[-3:] / ARCSECOND_RAD, sigma[-3:] / ARCSECOND_RAD
    rows += [
        (f'alignment {axis}', '', '', f'{d:+.2f}"', f'{s:.2f}"', _sigmas(d, s))
        for axis, d, s in zip('xyz', arcsec, sigma_arcsec, strict=True)
    ]
    print_table(('parameter', 'A', 'B', 'B - A', '1-sigma', 'in sigmas'), rows)
    print_table(
        ('lines of sight', 'worst', 'rms', 'worst', 'rms'),
        [
            ('as calibrated', *_map_cells(comparison.before)),
            ('common rotation removed', *_map_cells(comparison.after)),
        ],
    )
    print_text(f'common rotation {comparison.rotation_rad / ARCSECOND_RAD:.2f}"')
    total = comparison.total
    if total.degrees_of_freedom:
        print_text(
            f'all parameters  chi2 {total.value:.1f}, {total.degrees_of_freedom} degrees of '
            f'freedom, p-value {p_value_text(total.p_value)}'
        )
    for note in comparison.notes:
        print_text(f'note: {note}')


def _map_cells(found: DifferenceMap) -> Sequence[str]:
    length = found.length_px
    cells = [f'{length.max():.4f} px', f'{np.sqrt(np.mean(length**2)):.4f} px']
    known = found.sigmas[np.isfinite(found.sigmas)]
    if not known.size:
        return [*cells, '', '']
    worst, rms = known.max(), np.sqrt(np.mean(known**2))
    return [*cells, f'{worst:.2f} sigma', f'{rms:.2f} sigma']


def _sigmas(difference: float, sigma: float) -> str:
    return f'{difference / sigma:+.1f}' if sigma > 0 else ''


def _counted(counts: Mapping[str, int]) -> str:
    return ', '.join(f'{count} {reason}' for reason, count in counts.items()) or 'none'


def _predicted(name: str, sigma: float) -> str:
    if not np.isfinite(sigma):
        return 'not observable yet'
    return (
        f'{sigma / ARCSECOND_RAD:.2f}"' if name.startswith('alignment') else significant(sigma, 2)
    )


def _topic_notes(topic: TopicContent) -> list[str]:
    notes = [f'{utc_text(topic.first_ns)} to {_clock(topic.last_ns)}']
    if topic.kinds:
        notes.append(', '.join(f'{count} x {kind}' for kind, count in topic.kinds.items()))
    if topic.bad:
        notes.append(f'{topic.bad} of {topic.count} messages are invalid')
    if topic.backward:
        notes.append(f'stamps go back {topic.backward} times')
    return notes


def _clock(time_ns: int) -> str:
    return utc_text(time_ns).partition(' ')[2]
