# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The setup finder beside a star observer: a wrong set-up, and an alignment that is not given."""

from pathlib import Path

from geometry_msgs.msg import QuaternionStamped
import numpy as np
import pytest
from sensor_msgs.msg import Image
from vehicle import ATTITUDES, Client, IMAGES, REMAPS  # type: ignore[import-not-found]
import yaml

from starcal.msg import SetupDiagnosis
from starcal_ground.bags import reader

pytestmark = pytest.mark.nodes

ZEROS = 'prior_alignment:=[0.0, 0.0, 0.0, 0.0]'


def play(client: Client, bag: Path, nodes: int = 2) -> None:
    """Publish the attitudes of a bag, then its images, to a number of nodes."""
    images = client.publisher(Image, IMAGES, 20)
    attitudes = client.publisher(QuaternionStamped, ATTITUDES)
    for publisher in (images, attitudes):
        client.until(lambda publisher=publisher: publisher.get_subscription_count() == nodes)
    for sample in reader.read_raw([bag], [ATTITUDES]):
        attitudes.publish(sample.data)
    for image in reader.read_raw([bag], [IMAGES]):
        images.publish(image.data)


def test_five_images_without_a_match_are_diagnosed_until_images_match(vehicle) -> None:
    wrong = 'attitude_direction:=inertial_to_st'
    names = ('setup_finder', 'star_observer')
    _, observer = (vehicle.start(name, wrong, ros=REMAPS) for name in names)
    for name in names:
        vehicle.until(lambda name=name: vehicle.health(name)[1] == 'waiting for images')
    said = vehicle.latched(SetupDiagnosis, 'setup_diagnosis')
    play(vehicle, vehicle.bag)
    vehicle.until(lambda: said)
    assert said[0].cause == 'attitude_direction'
    assert said[0].parameters == ['attitude_direction: st_to_inertial']
    vehicle.until_value('diagnosis', 'attitude_direction', 'setup_finder')
    level, text, values = vehicle.health('setup_finder')
    assert level == b'\x01' and 'Set attitude_direction: st_to_inertial.' in text
    assert (values['diagnosis'], values['callback_errors']) == ('attitude_direction', '0')
    vehicle.until_value('refused_no_match', '10')
    observer.stop()
    again = vehicle.start('star_observer', ros=REMAPS)
    vehicle.until(lambda: vehicle.health()[1] == 'waiting for images')
    play(vehicle, vehicle.bag)
    vehicle.until(lambda: said[-1].cause == 'none')
    vehicle.until(lambda: vehicle.health('setup_finder')[1] == 'images match')
    assert 'Traceback' not in again.said()


def test_an_alignment_not_given_is_found(vehicle) -> None:
    """The star observer does not start without one, and names the two ways to find it."""
    observer = vehicle.start('star_observer', ZEROS, ros=REMAPS)
    assert observer.wait() == 2
    refusal = 'prior_alignment: not given: starcal calibrate BAG finds it from a recording,'
    assert f'{refusal} setup_finder beside the camera' in observer.said()
    assert 'Traceback' not in observer.said()
    finder = vehicle.start('setup_finder', ZEROS, ros=REMAPS)
    vehicle.until(lambda: vehicle.health('setup_finder')[1].endswith('waiting for images'))
    said = vehicle.latched(SetupDiagnosis, 'setup_diagnosis')
    play(vehicle, vehicle.bag, nodes=1)
    vehicle.until(lambda: any(one.cause == 'prior_alignment' for one in said))
    (line,) = said[-1].parameters
    found = yaml.safe_load(line)['prior_alignment']
    given = yaml.safe_load((vehicle.bag / 'params.yaml').read_text())['/**']['ros__parameters']
    # The stars of one image show its rotation to some arcseconds, the star tracker errs by 10.
    turn = abs(np.dot(found, given['prior_alignment']))
    assert 2.0 * np.arccos(min(turn, 1.0)) < np.radians(1.0)
    vehicle.until(lambda: f'Set prior_alignment: {found}' in finder.said())
