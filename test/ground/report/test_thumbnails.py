# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Small pictures: how many are kept, what they show, and that they come back from a folder."""

import os

import cv2
import numpy as np
import pytest

from starcal_ground.report.thumbnails import Album, read_thumbnails, Thumbnail, write_thumbnails
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.errors import ProductError
from starcal_ros.records import CameraGeometry, Image, StarObservations

CAMERA = CameraModel(640, 512, np.array([1800.0, 0, 1800, 319.5, 255.5, 0, 0, 0, 0, 0]))
GEOMETRY = CameraGeometry(CAMERA, np.array([0.0, 0, 0, 1]))
RNG = np.random.default_rng(5)
PIXELS = RNG.poisson(40, (512, 640)).astype(np.uint8)
PIXELS[100, 200] = 255


def album_of(count: int, refused_every: int) -> Album:
    """Images without stars used and with one left out."""
    album = Album()
    for k in range(count):
        seen = StarObservations.of_image(
            k,
            (640, 512),
            refusal='no_stars' if k % refused_every == 0 else '',
            refused_stars={'saturated': 1},
            refused_catalog_id=np.array([7]),
            refused_px=np.array([[200.0, 100.0]], np.float32),
            refused_reason=np.array([0], np.uint8),
        )
        album.show(Image(k, PIXELS), seen, GEOMETRY)
    return album


def test_few_are_kept_of_many_evenly_and_all_of_few() -> None:
    album = album_of(400, refused_every=50)
    used = [one.observations.time_ns for one in album.used]
    assert 6 <= len(used) < 12
    steps = np.diff(used)
    # The images between have been refused now and then: a step is longer by those at most.
    assert steps.max() - steps.min() <= 2
    assert used[-1] > 400 - 2 * steps.max()
    assert [one.observations.time_ns for one in album.refused['no_stars']] == [0, 50]
    few = [one.observations.time_ns for one in album_of(5, refused_every=100).used]
    assert few == [1, 2, 3, 4]


def test_a_large_image_is_reduced_before_it_is_drawn() -> None:
    """A used star is marked at its place in the smaller picture."""
    rng = np.random.default_rng(2)
    large = rng.poisson(40, (2048, 2592)).astype(np.uint16)
    camera = CameraModel(2592, 2048, np.array([7e3, 0, 7e3, 1295.5, 1023.5, 0, 0, 0, 0, 0]))
    geometry = CameraGeometry(camera, np.array([0.0, 0, 0, 1]))
    place = np.array([[1944.0, 512.0]])
    one = np.ones(1, np.float32)
    record = StarObservations.of_image(
        *(1, (2592, 2048)), catalog_id=np.array([1]), direction_icrf=line_of_sight(camera, place),
        measured_px=place, covariance_px2=np.ones((1, 3)), magnitude=one, flux_dn=one, snr=one,
    )  # fmt: skip
    album = Album()
    album.show(Image(1, large), record, geometry)
    (thumbnail,) = album.thumbnails()
    picture = cv2.imdecode(np.frombuffer(thumbnail.encoded, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (379, 480, 3)
    coloured = np.argwhere(np.ptp(picture.astype(int), axis=2) > 60)
    # A quarter of the way from the right and from the top; marks are 8 px wide.
    np.testing.assert_allclose(coloured.mean(axis=0), [94.5, 359.9], atol=2.0)


def test_a_folder_keeps_what_was_written_and_nothing_older(tmp_path) -> None:
    folder = tmp_path / 'thumbnails'
    write_thumbnails(album_of(40, refused_every=10).thumbnails(), folder)
    (folder / 'notes.txt').write_text('mine')
    album = album_of(3, refused_every=2)
    write_thumbnails(album.thumbnails(), folder)
    assert set(read_thumbnails(folder)) == set(album.thumbnails())
    (folder / 'expected_1.png').write_bytes(b'\x89PNG\r\n\x1a\n')
    assert [one.is_expected for one in read_thumbnails(folder)] == [False, False, True, False]
    assert (folder / 'notes.txt').read_text() == 'mine'
    assert read_thumbnails(tmp_path / 'nowhere') == ()


def test_only_pictures_of_the_folder_are_read(tmp_path) -> None:
    """No link, FIFO, huge file or other content: it would be in the report."""
    secret, folder = tmp_path / 'secret', tmp_path / 'thumbnails'
    secret.write_bytes(b'\xff\xd8\xff secret')
    own = Thumbnail(1, b'\xff\xd8\xff')
    write_thumbnails([own], folder)
    (folder / 'image_2.jpg').symlink_to(secret)
    os.mkfifo(folder / 'image_3.jpg')
    (folder / 'image_4.jpg').write_bytes(b'no picture')
    (folder / 'image_5.jpg').write_bytes(b'\xff\xd8\xff' + bytes(2 << 20))
    (folder / 'expected_6.png').mkdir()
    assert read_thumbnails(folder) == (own,)
    (tmp_path / 'link').symlink_to(folder)
    assert read_thumbnails(tmp_path / 'link') == ()
    with pytest.raises(ProductError, match='is a link'):
        write_thumbnails([own], tmp_path / 'link')
    assert secret.read_bytes() == b'\xff\xd8\xff secret'
