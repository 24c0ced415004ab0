# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""From FITS and an attitude ephemeris to the calibration of the original bag."""

from collections.abc import Sequence
import hashlib
import json
from pathlib import Path
import shutil

from astropy.io import fits
from mission_files import (  # type: ignore[import-not-found]
    attitudes,
    date,
    FRAME_ID,
    images,
    TINY,
    write_aem,
    write_ck,
    write_fits,
    write_velocities,
)
import numpy as np
import pytest
from starcal_tool import Answer, assert_refused, Starcal  # type: ignore[import-not-found]
import yaml

import starcal_ground
from starcal_ground.bags import reader
from starcal_ground.bags.frames import read_telemetry
from starcal_ground.bags.reader import Topics
from starcal_ros.constants import utc_text
from starcal_ros.records import Image, ORIGINAL, PIXELS_OF

pytestmark = pytest.mark.usefixtures('forked_readers')

ALIGNMENT = yaml.safe_load((TINY / 'params.yaml').read_text())['/**']['ros__parameters'][
    'prior_alignment'
]


@pytest.fixture(scope='module')
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The images of the small bag as FITS, in names whose order is not that of time."""
    folder = tmp_path_factory.mktemp('night')
    for number, image in enumerate(images()):
        write_fits(folder / f'{9 - number}.fits', image, 'tiled')
    return folder


@pytest.fixture
def aem(tmp_path: Path) -> Path:
    return Path(write_aem(tmp_path / 'a.aem'))


def digests_of_originals(made: starcal_ground.Calibration) -> dict[str, str]:
    names = [name for name in made.provenance if name.startswith(ORIGINAL)]
    return {name.removeprefix(ORIGINAL): made.provenance[name] for name in names}


@pytest.fixture
def run(starcal: Starcal) -> Starcal:
    """Import images with attitudes, by default into `bag` beside these."""

    def imported(
        aem: Path, *images_of: Path, bag: Path | None = None, more: Sequence[object] = ()
    ) -> Answer:
        places = ['--attitude', aem, '-o', bag or aem.parent / 'bag']
        return starcal('import', '--images', *images_of, *places, *more)

    return imported


@pytest.mark.slow
def test_an_imported_bag_gives_the_original_calibration(night, aem, tiny, tmp_path, run) -> None:
    bag = tmp_path / 'bag'
    velocities = ['--velocity', write_velocities(tmp_path / 'velocity.csv')]
    prior = ['--camera', TINY / 'camera.yaml', '--alignment', *ALIGNMENT]
    out = run(aem, night / '*.fits', more=[*velocities, *prior]).out
    assert '10 images' in out and 'params.yaml -o DIR' in out
    found = list(reader.read_images([bag], '/camera/image_raw'))
    for a, b in zip(found, images(), strict=True):
        assert isinstance(a, Image) and a.time_ns == b.time_ns and (a.pixels == b.pixels).all()
    # The file of the original: it has the sigma of the star tracker too.
    imported = starcal_ground.calibrate_bag(bag, TINY / 'params.yaml')
    originals = [*night.iterdir(), aem, tmp_path / 'velocity.csv']
    assert digests_of_originals(imported) == {
        str(path): f'sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}' for path in originals
    }
    # Quaternions are scaled to unit length on the way: a rounding of 1e-16.
    change = np.abs(imported.geometry.camera.parameters - tiny.geometry.camera.parameters)
    assert (change <= 1e-6 * tiny.sigma[:-3]).all()
    assert starcal_ground.calibrate_bag(bag, bag / 'params.yaml').accepted
    record = json.loads((bag / 'import.json').read_text())
    assert record['scale'] == {'offset': 0.0, 'step': 1.0, 'dtype': images()[0].pixels.dtype.name}


def test_a_ck_has_an_attitude_at_each_image(night, tmp_path, run) -> None:
    kernels = write_ck(tmp_path)
    bag = tmp_path / 'bag.mcap'
    attitude = ['--attitude', *kernels, '--star-tracker', FRAME_ID]
    # A folder, and a file of it again.
    assert run(kernels[0], night, night / '3.fits', bag=bag, more=attitude).status == 0
    topics = Topics('/camera/image_raw', '/star_tracker/attitude')
    held = read_telemetry([bag], topics).attitudes
    for image in images()[1:-1]:
        assert held.at(image.time_ns, 0.1)[1] == 0.0
    assert (tmp_path / 'bag_import.json').exists()


@pytest.mark.slow
def test_several_star_trackers_of_one_aem(night, aem, tmp_path, run) -> None:
    start = aem.read_text().index('META_START')
    second = aem.read_text()[start:].replace('STARTRACKER_1', 'ST-2')
    aem.write_text(aem.read_text() + second)
    bag = tmp_path / 'bag'
    more = ['--camera', TINY / 'camera.yaml', '--star-tracker', 'STARTRACKER_1']
    more += ['--more-star-trackers', 'ST-2', '--alignment', *ALIGNMENT]
    few = run(aem, night / '*.fits', more=more)
    assert_refused(few, '--alignment: 4 numbers, 8 are needed')
    assert run(aem, night / '*.fits', more=[*more, *ALIGNMENT]).status == 0
    first, other = (
        [raw.data for raw in reader.read_raw([bag], [topic])]
        for topic in ('/star_tracker/attitude', '/ST_2/attitude')
    )
    assert first == other and len(first) == len(attitudes())
    found = starcal_ground.calibrate_bag(bag, bag / 'params.yaml')
    assert found.accepted
    values = yaml.safe_load((bag / 'params.yaml').read_text())['/**']['ros__parameters']
    assert values['more_star_trackers'] == ['ST_2']
    assert values['more_alignments'] == list(ALIGNMENT)


def test_images_without_attitudes_are_named_and_if_all_are_refused(night, aem, run) -> None:
    whole = aem.read_text()
    lines = whole.splitlines()
    start = lines.index('DATA_START') + 1
    count = len(attitudes())
    # The middle third is missing: a gap, and what is after the end.
    kept = lines[: start + count // 3] + lines[start + 2 * count // 3 : -4] + ['DATA_STOP']
    aem.write_text('\n'.join(kept) + '\n')
    out = run(aem, night / '*.fits').out
    assert 'images are in gaps of up to' in out and 'have no attitude about them' in out
    # Attitudes of another day are refused.
    aem.write_text(whole.replace('2026-05-15T07:', '2027-05-15T07:'))
    spans = [
        f'{utc_text(times[0])} to {utc_text(times[-1])}'
        for times in ([image.time_ns for image in images()], [time for time, _ in attitudes()])
    ]
    assert_refused(
        run(aem, night / '*.fits'),
        f'the images are from {spans[0]}, the attitudes of another time, from 2027',
        spans[1].replace('2026', '2027'),
    )


def test_an_imported_bag_is_replaced_but_not_its_prior(night, aem, tmp_path, run) -> None:
    (tmp_path / 'bag').mkdir()
    camera = shutil.copy(TINY / 'camera.yaml', tmp_path / 'bag/camera.yaml')
    for images_of in ('[0-3].fits', '*.fits'):
        answer = run(aem, night / images_of, more=['--camera', camera])
        assert answer.status == 0, answer
    assert len(json.loads((tmp_path / 'bag/import.json').read_text())['images']) == 10


def test_hostile_files_are_named_by_reason_in_one_line(night, aem, tmp_path, run) -> None:
    for name in ('cut.fits', 'cut2.fits'):
        (tmp_path / name).write_bytes(b'nothing')
    with (tmp_path / 'huge.fits').open('wb') as file:
        file.write(fits.PrimaryHDU(np.zeros((2, 2))).header.tostring().encode())
        file.seek(80 * 3)  # NAXIS1 and NAXIS2: 968 MB, all of them a hole in the file
        for axis in (1, 2):
            file.write(f'NAXIS{axis}  = {11000:20}'.ljust(80).encode())
        file.truncate(2880 * (2 + 11000 * 11000 * 8 // 2880))
    answer = run(aem, night / '0.fits', tmp_path / '*.fits')
    assert not (tmp_path / 'bag').exists()
    by_content = 'cannot be used: 2 files (cut.fits, cut2.fits): not an image in FITS, TIFF or PNG'
    assert_refused(answer, by_content, '1 file (huge.fits): needs more than 1 GB of memory')


def test_the_pixels_of_the_camera_are_in_the_record(aem, tmp_path, run) -> None:
    for number, image in enumerate(images()[:3]):
        upside_down = Image(image.time_ns, image.pixels[::-1].copy())
        header = {'DATE-AVG': date(image.time_ns), 'ROWORDER': 'BOTTOM-UP'}
        write_fits(tmp_path / f'{number}.fits', upside_down, **header)
    note = 'pixels of the images: rows last to first (ROWORDER)'
    assert note in run(aem, tmp_path / '*.fits').out
    assert note in json.loads((tmp_path / 'bag/import.json').read_text())['notes']
    read = list(reader.read_images([tmp_path / 'bag'], '/camera/image_raw'))
    for one, image in zip(read, images(), strict=False):
        assert isinstance(one, Image) and (one.pixels == image.pixels).all()
    names = {one.time_ns: str(tmp_path / f'{k}.fits') for k, one in enumerate(read)}
    assert reader.image_files([tmp_path / 'bag']) == names


@pytest.mark.slow
def test_originals_and_pixels_of_two_imported_bags_with_files_of_one_name(
    night, aem, tmp_path, run
) -> None:
    flipped = ['--camera', TINY / 'camera.yaml', '--alignment', *ALIGNMENT, '--flip', 'top-bottom']
    for name in ('one', 'two'):
        folder = tmp_path / 'night'
        folder.mkdir(exist_ok=True)
        for k, path in enumerate(sorted(night.iterdir())[5 * (name == 'two') :][:5]):
            shutil.copy(path, folder / f'{k}.fits')
        assert run(aem, folder / '*.fits', bag=tmp_path / name, more=flipped).status == 0
    originals = reader.origin_of([tmp_path / 'one', tmp_path / 'two'])
    assert originals.pop(PIXELS_OF) == 'mirrored top to bottom (--flip)'
    names = [str(tmp_path / 'night' / f'{k}.fits') for k in range(5)]
    inputs = {*names, *(f'{name} (of another bag)' for name in names), str(aem)}
    assert {*originals} == {f'{ORIGINAL}{name}' for name in inputs}
    assert len({*originals.values()}) == 11
    assert not reader.origin_of([TINY])


@pytest.mark.slow
def test_imports_and_simulations_do_not_replace_each_other(night, tmp_path, run, starcal) -> None:
    """Each may be repeated: the files beside a bag would else be those of another one."""
    aem, imported, simulated = write_aem(tmp_path / 'a.aem'), tmp_path / 'bag', tmp_path / 'sim'
    simulate = ['simulate', '--scenario', 'tiny', '--images', 2, '-o']
    for _ in range(2):
        assert run(aem, night / '0.fits').status == 0
        assert starcal(*simulate, simulated).status == 0
    assert_refused(starcal(*simulate, imported), 'without truth.json')
    assert_refused(run(aem, night / '0.fits', bag=simulated), 'without import.json')


@pytest.mark.slow
def test_observations_carry_the_originals_of_their_bag(night, tmp_path, run, starcal) -> None:
    aem, bag, out = write_aem(tmp_path / 'a.aem'), tmp_path / 'bag', tmp_path / 'out'
    assert run(aem, night / '*.fits').status == 0
    params = ['--params', str(TINY / 'params.yaml'), '--no-report', '--quiet']
    for given, made in ((bag, out), (out / 'observations.mcap', tmp_path / 'again')):
        assert starcal('calibrate', given, '-o', made, *params).status == 0
        originals = digests_of_originals(starcal_ground.read_calibration(made))
        assert {*originals} == {str(aem), *map(str, night.iterdir())}
    # Headers of the images name their files, of any generation.
    headers = tmp_path / 'headers'
    assert starcal('export', tmp_path / 'again', '--to', 'wcs', '-o', headers).status == 0
    for name, k in (('image0001.wcs', 9), ('image0010.wcs', 0)):
        header = fits.getheader(headers / name)
        assert header['FILENAME'] == f'{k}.fits'
        assert originals[str(night / f'{k}.fits')] in ''.join(header['HISTORY'])
    # The block for signatures of the report has them.
    assert starcal('report', tmp_path / 'again').status == 0
    page = (tmp_path / 'again' / 'report.html').read_text()
    assert all(digest in page for digest in originals.values())


def test_a_coarse_scale_is_named(aem, tmp_path, run) -> None:
    write_fits(tmp_path / '0.fits', images()[0], 'float32')
    out = run(aem, tmp_path / '0.fits', more=['--value-range', 0, 2e6]).out
    assert 'a step of 16 bit is' in out and 'pixel values are 0 + 30.7692308 DN' in out
