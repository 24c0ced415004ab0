# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Pictures of images that match no star: the stars expected there beside the sources seen."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from starcal_ros.identification.prediction import in_image, predict
from starcal_ros.lost_in_space.bright_sources import bright_sources
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Image, StarObservations
from starcal_ros.report.pictures.annotation import stretch
from starcal_ros.report.pictures.thumbnails import Thumbnail

EXPECTED = 'no_match_expected'  # in the names of these pictures
_PICTURES = 3
_SHOWN = 40  # brightest stars and sources
_WIDTH_PX = 900
_EXPECTED_BGR, _SEEN_BGR = (80, 200, 255), (120, 255, 120)


@dataclass
class ExpectedAlbum:
    """The first images of a set that match no star, drawn as they are shown."""

    setup: Setup
    pictures: list[Thumbnail] = field(default_factory=list)

    def show(self, image: Image, observations: StarObservations, geometry: CameraGeometry) -> None:
        """Add an image if it matched no star; ``geometry`` predicts the stars."""
        if observations.refusal == 'no_match' and len(self.pictures) < _PICTURES:
            picture = _picture(image, observations, geometry, self.setup)
            number = len(self.pictures)
            self.pictures.append(Thumbnail(image.time_ns, EXPECTED, number, picture))


def _picture(
    image: Image, observations: StarObservations, geometry: CameraGeometry, setup: Setup
) -> bytes:
    """PNG with crosses where the brightest stars are expected and circles about the sources."""
    camera = geometry.camera
    prediction = predict(
        geometry,
        observations.icrf_from_star_tracker_xyzw,
        image.time_ns,
        setup.catalog,
        setup.identification.magnitude_limit,
        0.0,
    )
    inside = in_image(prediction.xy_px, camera.width, camera.height)
    magnitude = setup.catalog.magnitude[prediction.catalog_index]
    order = np.argsort(np.where(inside, magnitude, np.inf), kind='stable')
    scale = min(1.0, _WIDTH_PX / image.pixels.shape[1])
    grey = cv2.resize(
        stretch(image.pixels), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
    )
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    for u, v in prediction.xy_px[order[: min(_SHOWN, int(inside.sum()))]]:
        place = (round(float(u) * scale), round(float(v) * scale))
        cv2.drawMarker(picture, place, _EXPECTED_BGR, cv2.MARKER_CROSS, 13, 1, cv2.LINE_AA)
    for u, v in bright_sources(image.pixels).xy_px[:_SHOWN]:
        place = (round(float(u) * scale), round(float(v) * scale))
        cv2.circle(picture, place, 8, _SEEN_BGR, 1, cv2.LINE_AA)
    _, encoded = cv2.imencode('.png', picture)
    return encoded.tobytes()
