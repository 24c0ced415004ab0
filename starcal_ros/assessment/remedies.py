# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Remedies for refused images, failed checks, contradicted assumptions and causes of a sigma."""

from __future__ import annotations

from collections.abc import Mapping

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
    'out_of_order': 'use one topic for each camera',
    'overexposed': 'expose for a shorter time',
    'blank': 'check that the camera is read out',
    'frozen': 'check that the camera is read out',
    'incomplete': 'if rows of the detector are dead, raise max_lost_fraction; else mend the link',
    'glare': 'keep Sun, Moon and Earth out of the field',
    'smeared': 'expose for a shorter time, or point more steadily',
    'not_in_catalog': (
        'raise magnitude_limit, or give starcal catalog a table of this sky (docs/mission.md)'
    ),
    'no_match': 'ask the diagnostics of the star observer, or starcal diagnose, for the cause',
    'too_few_stars': 'expose for longer, or raise magnitude_limit; check bad_pixel_map',
    # Checks of the gate, by option, with the section of the report.
    'max_rejected_fraction': 'look for smeared or misidentified stars (Residuals), and check the'
    ' attitudes and stamps of misfit images (Alignment)',
    'min_images': 'take more images',
    'min_coverage': 'take images with stars in the empty cells (Coverage)',
    'max_rotation_deg': 'check the alignment assumed (prior_alignment) and the mounting',
    'change of the camera': 'find out if the camera has changed',
    'change of the mounting': 'find out if the mounting has changed',
    # Assumed values that the stars contradict, by the start of their label, and faults they show.
    'assumed velocity': 'check the velocity topic, the stamps and the site',
    'assumed readout': 'check shutter and readout_s',
    'assumed stamp': 'check stamp_offset_s and the clocks of camera and star tracker',
    'assumed mounting': 'check more_alignments',
    'detector step': 'columns or rows are lost or shifted there: check the read-out',
    # Causes of the sigma of a line of sight (`SigmaPart.cause`).
    'stars': 'take more images',
    'velocity': 'state the velocity of the camera: the topic velocity or observer_velocity_m_s; '
    'of photographs, observer and their times (EXIF, FITS)',
    'read-out': 'state the shutter and its read-out time (shutter, readout_s)',
    'stamps': 'state the uncertainty of the time stamps (stamp_sigma_s)',
    'field': 'take more images with stars at other places on the detector',
    'fine structure': 'take more images with stars at other places on the detector',
    'change from image to image': 'estimate with temperature, or calibrate each state alone',
    'star places': 'take more images of other star fields, with a catalog that has proper motions',
    'mountings': 'state the 1-sigma of the mountings (star_tracker_mounting_sigma_arcsec)',
    'temperature': 'take images over a wider range of temperatures',
    'star tracker noise': 'take more images',
    'star tracker slow error': 'take images in more attitudes of the star tracker',
    'held parameters': 'estimate the held parameters (estimate)',
}
"""Name -> remedy; a check of the gate that has none states it in its note."""
