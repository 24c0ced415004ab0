# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Remedies against refused images, failed checks and causes of a sigma."""

from __future__ import annotations

from collections.abc import Mapping

from starcal_ros.estimation.unknowns import remedy_of


def remedy_against(cause: str) -> str:
    """Remedy that lowers the part of a sigma by a cause; empty where there is none."""
    return remedy_of(cause) or REMEDIES.get(cause, '')


REMEDIES: Mapping[str, str] = {
    # Reasons to refuse images (`IMAGE_REFUSALS`).
    'bad_encoding': 'record images of one channel, 8 or 16 bit, raw, as PNG or JPEG',
    'bad_layout': 'correct width, height, step and data where the message is made',
    'bad_stamp': 'stamp the images in UTC since 1970, and check stamp_offset_s',
    'bad_attitude': 'send unit quaternions, and none while the star tracker has no lock',
    'no_attitude': 'record attitudes from before the first image to after the last',
    'attitude_gap': (
        'record attitudes more often, or raise max_attitude_gap_s if the vehicle turns evenly'
    ),
    'frozen_attitude': 'record the attitudes that the star tracker measures',
    'out_of_order': 'use one topic for each camera, and send images in the order of their stamps',
    'overexposed': 'expose for a shorter time',
    'blank': 'check that the camera is read out',
    'frozen': 'check that the camera is read out, and that one publisher sends each frame',
    'duplicate': 'give each image once: a copy adds nothing',
    'incomplete': 'if rows of the detector are dead, raise max_lost_fraction; else mend the link',
    'glare': 'keep Sun, Moon and Earth out of the field',
    'smeared': 'expose for a shorter time, or point more steadily',
    'not_in_catalog': (
        'raise magnitude_limit, or give starcal catalog a table of this sky (docs/mission.md)'
    ),
    'no_match': 'ask starcal diagnose, or setup_finder beside the nodes, for the cause',
    'too_few_stars': (
        'expose for longer, or raise magnitude_limit, with a deeper catalog (starcal catalog) in a'
        ' field of few stars; check bad_pixel_map'
    ),
    # Checks of the gate, with the section of the report.
    'stars left out as outliers': 'look for smeared or misidentified stars (Residuals)',
    'images whose attitude does not fit': 'check their attitudes and stamps (Alignment)',
    'coverage': 'take images with stars in the empty cells (Coverage)',
    'mounting of the prior': 'check prior_alignment and the mounting',
    'change of the camera': 'find out if the camera has changed',
    'change of the mounting': 'find out if the mounting has changed',
    # Faults that the stars show.
    'detector step': 'columns or rows are lost or shifted there: check the read-out',
    # Causes of the sigma of a line of sight (`SigmaPart.cause`) that are no unknowns.
    'stars': 'take more images',
    'fine structure': 'take more images with stars at other places on the detector',
    'star places': 'take images of other star fields, with a catalog that has proper motions',
    'star tracker noise': 'take more images',
    'star tracker slow error': 'take images in more attitudes',
    'held parameters': 'estimate the held parameters (estimate)',
}
"""Name -> remedy; that of a check which failed is in its note, that of an unknown in its row."""
