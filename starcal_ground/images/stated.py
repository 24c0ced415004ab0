# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Facts that the files of a set state, compared with their stars and with the catalog."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
import math

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.blind.images import FEWEST_SOURCES
from starcal_ground.images.fits_facts import FocalLength
from starcal_ground.images.from_stars import FromStars
from starcal_ground.images.photographs import GIVEN, Photograph
from starcal_ros.camera import CameraModel
from starcal_ros.sky.astrometry import air_above, SiteOptions
from starcal_ros.sky.catalog import StarCatalog

# Half field under which the bundled catalog may have too few stars for a search.
_NARROW_RAD = math.radians(2.0)
_MOUNT_RAD = math.radians(1.0)  # error of the pointing that a mount reports
# Stars of the deepest part of a catalog: the densest field is about one of them.
_FAINTEST = 10_000
_NEAR_POLE = 0.02  # sine of the distance from the pole: north has no direction there
# Mean of the doubled position angles on both sides of a mount, which scatter by some degrees.
_SAME_SIDES = 0.98
_SITE = ('observer', 'latitude_deg', 'longitude_deg', 'height_m')


def focal_lengths_of(
    photographs: Sequence[Photograph],
) -> list[FocalLength]:
    """Focal lengths that photographs state, each the median of the images that state it."""
    of_files: dict[str, list[float]] = {}
    for one in photographs:
        for stated in one.focal_lengths:
            of_files.setdefault(stated.keywords, []).append(stated.focal_px)
    return [
        FocalLength(float(np.median(focal_px)), keywords)
        for keywords, focal_px in of_files.items()
    ]


def times_of(photographs: Sequence[Photograph]) -> str:
    """Where stamps are from that are not of the images; empty if there are none."""
    undated = [one for one in photographs if not one.dated]
    if not undated:
        return ''
    why = next((f': {one.doubt}' for one in undated if one.doubt), '')
    return f'of the file: {len(undated)} of {len(photographs)} images state none{why}'


def doubt_of_times(photographs: Sequence[Photograph]) -> str:
    """Note on times whose zone is in doubt; empty if there are none."""
    doubts = [one.doubt for one in photographs if one.dated and one.doubt]
    if not doubts:
        return ''
    return f'the time zone of {len(doubts)} of {len(photographs)} images is not known: {doubts[0]}'


def half_turns(stars: FromStars) -> str:
    """Note on images that are turned by half a turn about the line of sight; empty if none is."""
    axes = Rotation.concatenate([*stars.icrf_from_camera.values()]).as_matrix()
    across, along = axes[:, :, 0], axes[:, :, 2]
    east = np.cross([0.0, 0.0, 1.0], along)
    length = np.linalg.norm(east, axis=1)
    north = np.cross(along, east)
    angle_rad = np.arctan2((across * north).sum(axis=1), (across * east).sum(axis=1))
    # Twice the angle is the same for both sides of a mount; it scatters for a tripod.
    doubled = np.exp(2j * angle_rad)
    if length.min() < _NEAR_POLE or len(angle_rad) < 2 or abs(doubled.mean()) < _SAME_SIDES:
        return ''
    middle = 0.5 * np.angle(doubled.mean())
    turned = np.cos(angle_rad - middle) < 0
    few = min(int(turned.sum()), int((~turned).sum()))
    if not few:
        return ''
    return (
        f'{few} of {len(turned)} images are turned by 180 degrees against the others: a meridian'
        ' flip of the mount; if a program has turned the files, calibrate them apart'
    )


def site_of(photographs: Sequence[Photograph], stars: FromStars) -> tuple[dict[str, object], str]:
    """
    Options of the site, if all files have a position and a date, and a note on one that is wrong.

    A site below whose horizon images are is that of another place, mostly of a longitude that
    counts west, or its clock is not UTC; the camera is on the ground all the same.
    """
    sites = [one.site for one in photographs if one.site is not None and one.dated and one.utc]
    if len(sites) < len(photographs):
        return {}, ''
    latitude, longitude, height_m = sites[0]
    site = SiteOptions('ground', latitude, longitude, height_m)
    if not _is_below_horizon(site, stars):
        options = dataclasses.asdict(site)
        return {name: options[name] for name in _SITE}, ''
    is_west = not _is_below_horizon(dataclasses.replace(site, longitude_deg=-longitude), stars)
    west = (
        f', or longitudes count west: --set observer=ground --set latitude_deg={latitude:g}'
        f' --set longitude_deg={-longitude:g}'
    )
    return {'observer': 'ground'}, (
        f'the site of the files is not used: at longitude {longitude:g} the stars are below the'
        f' horizon: the clock is not UTC{west * is_west}'
    )


def _is_below_horizon(site: SiteOptions, stars: FromStars) -> bool:
    """True if more than a tenth of the images, a few of which may be misidentified, are below."""
    sines = [
        float(air_above(time_ns, site)[0] @ rotation.as_matrix()[:, 2])
        for time_ns, rotation in stars.icrf_from_camera.items()
    ]
    return float(np.percentile(sines, 10)) < 0.0


def too_few_stars(
    hints: Mapping[str, CameraModel],
    catalog: StarCatalog,
    is_own: bool,
    places: Sequence[tuple[float, float]],
) -> str:
    """
    Sentence for images of which each camera of ``hints`` has too few stars of the catalog, or ''.

    They are those about the richest of the places that images state, or the mean of the sky; of a
    catalog of the user (``is_own``) those of the densest field in it.
    """
    if not hints:
        return ''
    counts = [_stars_of_field(camera, catalog, is_own, places) for camera in hints.values()]
    if max(counts) >= FEWEST_SOURCES:
        return ''
    (by, camera), *_ = hints.items()
    across = ' x '.join(
        f'{2.0 * math.degrees(math.atan(0.5 * side / float(camera.parameters[0]))):.2f}'
        for side in (camera.width, camera.height)
    )
    place = f' at RA {places[0][0]:.2f}, Dec {places[0][1]:+.2f}' if places else ''
    return (
        f'a field of {across} deg ({by}){place} has {counts[0]:.1f} stars of the catalog,'
        f' {FEWEST_SOURCES} are needed: make a deeper one (starcal catalog) and state it (--set'
        f' catalog=FILE); if the field is wrong, give {GIVEN}'
    )


def _stars_of_field(
    camera: CameraModel,
    catalog: StarCatalog,
    is_own: bool,
    places: Sequence[tuple[float, float]],
) -> float:
    """Number of stars of the catalog in an image of a camera, as `too_few_stars` counts them."""
    half = 0.5 * np.array([camera.width, camera.height]) / float(camera.parameters[0])
    radius_rad = math.atan(float(np.hypot(*half)))
    area_sr = 4.0 * math.asin(float(np.prod(np.sin(np.arctan(half)))))  # sr of a pyramid
    if radius_rad > _NARROW_RAD or not (is_own or places):
        return len(catalog) * area_sr / (4.0 * math.pi)
    if is_own:
        centres = catalog.direction_icrs[-_FAINTEST:]
    else:
        centres = erfa.s2c(*np.radians(places).T)
        radius_rad += _MOUNT_RAD
    chord = 2.0 * math.sin(0.5 * radius_rad)
    most = int(catalog.tree.query_ball_point(centres, chord, return_length=True).max())
    return most if is_own else most * area_sr / (2.0 * math.pi * (1.0 - math.cos(radius_rad)))
