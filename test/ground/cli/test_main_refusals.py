# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Command lines and files with a mistake: one line names it, and nothing is written."""

from pathlib import Path
import shlex
import shutil

from mission_files import (  # type: ignore[import-not-found]
    frames_of,
    images,
    TINY,
    write_aem,
    write_encoded,
    write_fits,
    write_pngs,
    write_tiny,
)
import numpy as np
import pytest
from starcal_tool import assert_refused  # type: ignore[import-not-found]

from starcal_ground.bag_writer import BagWriter
from starcal_ros.records import Image, refused_image

FILES = {
    'no_head.yaml': 'camera_info_url: a.yaml\n',
    'no_node.yaml': 'ros__parameters: {camera_info_url: a.yaml}\n',
    'other_node.yaml': 'other_node:\n  ros__parameters: {a: 1}\n',
    'other_name.yaml': '/**:\n  ros__parameters: {camera_name: a}\n',
    'few.yaml': '/**:\n  ros__parameters: {min_images: few}\n',
    'ra_dec.csv': 'ra,dec\n1,2\n',
    'north.csv': 'ra_deg,dec_deg\n1,north\n',
    'none.csv': 'ra_deg,dec_deg\n',
    'beyond.csv': 'ra_deg,dec_deg\n1,95\n',
}
KEYS = {
    'bag': str(TINY),
    'bags': str(TINY.parent),
    'params': f'--params {TINY}/params.yaml',
    'stated': f'{TINY} --params {TINY}/params.yaml -o new',
    'import': 'import --attitude a.aem -o new --images',
}
WRONG: dict[str, tuple[str, ...]] = {
    'calibrat': ("'calibrat'", 'calibrate'),
    'diagnose a.mcap --image-topick=/a': ('--image-topick=/a', 'diagnose --help'),
    'diagnose none.mcap': ('none.mcap', 'no such file or folder'),
    "diagnose ''": ('empty path',),
    'calibrate': ('BAG',),
    'calibrate {bag}': ('-o/--output DIR: not given', 'e.g. -o out'),
    "calibrate {bag} {params} -o ''": ('--output',),
    'calibrate {bag} --params {bag}/tiny_0.mcap -o new': ('larger than',),
    'calibrate {bags} {params} -o new': ('did you mean', str(TINY)),
    'calibrate {bag} {params} -o notes.txt': ('notes.txt',),
    'calibrate {bag} --params no_head.yaml -o new': ('write /**: and ros__parameters: above',),
    'calibrate {bag} --params no_node.yaml -o new': ('write /**: above',),
    'calibrate {bag} --params other_node.yaml -o new': ('no section /**', 'other_node'),
    'calibrate {bag} --params other_name.yaml -o new': ('camera_name', 'other_name.yaml'),
    'calibrate {bag} --params few.yaml -o new': ('min_images', 'few.yaml'),
    'calibrate {bag} --params camera.yaml -o new': (
        'camera.yaml: a camera file', '--set camera_info_url=camera.yaml'),
    'calibrate {bag} -o new --set camera_info_url=none.yaml': (
        '--set camera_info_url: none.yaml: no such file',),
    'calibrate {bag} -o new --set camera_info_url=params.yaml': (
        'params.yaml: a parameter file, not a camera file: give it as --params',),
    'calibrate {bag} -o new --set observer=grond': ('--set observer', 'did you mean ground?'),
    'calibrate {bag} -o new --set obsrver=ground': ('--set obsrver', 'did you mean observer?'),
    'calibrate {bag} {params} -o new --set star_tracker_sigma_arcsec=[1,-5,1]': (
        ': --set star_tracker_sigma_arcsec[1]: -5',),
    'calibrate {bag} {params} -o new --set latitude_deg=10': (': --set latitude_deg, lo',),
    'calibrate {bag} -o new --set observer': ('--set', 'not of the form NAME=VALUE'),
    'calibrate {bag} -o new --observer ground': (
        'did you mean --set observer=VALUE?', 'starcal calibrate --help'),
    'calibrate {bag} -o new --require line=5arcsec': ('requirements: line is not',),
    'calibrate {bag} -o new --require map=5': ('unit', 'write map=5arcsec or map=5px'),
    'calibrate {bag} -o new --require map=5px@150%': ('the share at most 100 %',),
    'calibrate {bag} -o new --focal-length-mm 50': ('--pixel-size-um: bags need both',),
    'calibrate {stated} --focal-length-mm 50': ('a camera_info_url has them already',),
    'calibrate {bag} -o new --json --quiet': ('--quiet: not allowed with argument --json',),
    'calibrate {bag} -o new --jsn': ('unrecognized arguments: --jsn', 'calibrate --help'),
    'calibrate {stated} --from noon': ('--from', 'is not a time: give 2026'),
    'calibrate {stated} --from nan': ('--from', 'finite'),
    'calibrate {stated} --temperature-topic /box': ('/box', 'sensor_msgs/msg/Temperature'),
    # Two thermometers: which one, is asked only where it matters.
    'calibrate two.mcap {params} -o begun': ('No image of 1 can be used', 'as blank'),
    'calibrate two.mcap {params} -o new --set focal_temperature_order=1': (
        'several topics of type sensor_msgs/msg/Temperature', '/box, /lens'),
    'calibrate {stated} --from 2030-01-01T00:00:00': (
        '2026-05-15 07:20:00.000 UTC to 2026-05-15 07:20:36.000 UTC, +0 to +36 s',),
    'calibrate {stated} --from +5000': ('2026-05-15 07:20:36.000 UTC, +0 to +36 s',),
    'calibrate night {bag} -o new': (': a bag, and the other paths hold images',),
    'calibrate nothing -o new': ('nothing: no .mcap files in the folder, nor images',),
    'calibrate nothing/notes.txt -o new': ('notes.txt: not an MCAP bag, nor images',),
    # What is stated of a star tracker has to be there.
    'calibrate night -o new --set star_tracker_slow_arcsec=5': (
        'star_tracker_slow_arcsec: stated, but image files have no attitudes', '--camera-alone'),
    'calibrate night {params} -o new': ('a bag that has them (starcal import)',),
    'calibrate night.mcap -o begun --set star_tracker_slow_arcsec=5': ('--camera-alone',),
    'diagnose night --set star_tracker_slow_arcsec=5': ('--camera-alone',),
    'diagnose night/0.png {params}': ('a bag that has them (starcal import)',),
    'plan night --set star_tracker_slow_arcsec=5': ('--camera-alone',),
    # By the stars alone: a file that is none is named.
    'calibrate cut -o begun': ('no image can be read; left out: 1 file (001.fits): not',),
    'diagnose cut/001.fits': ('no image can be read; left out: 1 file (001.fits): not',),
    'calibrate observations.mcap -o begun': ('shows no camera: give the parameter file',),
    'calibrate colour.mcap -o begun': ('set image_channel, e.g. to green',),
    'calibrate colour.mcap {params} -o begun': ('set image_channel, e.g. to green',),
    'plan nothing': ('nothing: no .mcap files in the folder, nor images',),
    'plan {bag} {params} --pointings ra_dec.csv': ('no column ra_deg and dec_deg',),
    'plan {bag} {params} --pointings north.csv': (
        "line 2: could not convert string to float: 'north'",),
    'plan {bag} {params} --pointings none.csv': ('no pointings',),
    'plan {bag} {params} --pointings beyond.csv': ('--pointings: dec_deg is ',),
    'compare none': ('B',),
    'compare none none': ('none', 'No such file'),
    'compare {bag} {bag}': (str(TINY), 'no calibration.json'),
    'compare {bag}/truth.json {bag}/truth.json': ('truth.json', 'not a calibration'),
    'compare {bag}/params.yaml {bag}/params.yaml': ('params.yaml', 'not JSON'),
    'lookup products -o a.csv --points 1': ('--points', '1 is not within 2 to 2000'),
    'lookup products -o a': ('.csv', '.npz'),
    'lookup products -o none/a.csv': ('none', 'cannot be written'),
    'lookup . -o a.csv': ('no calibration.json',),
    'export . --to opencv -o new': ('holds no calibration.json',),
    'export products -o begun --to spice': ('--spacecraft-id',),
    'export products -o begun --to spice --spacecraft-id 5': ('not a negative NAIF ID',),
    'export products -o begun --to matlab': (
        "'matlab' is not one of spice, ck, wcs, isd, c, giant",),
    'export products -o begun --to opencvv': ('did you mean opencv',),
    'simulate -o new': ('--scenario',),
    'simulate -o new --scenario huge': ("'huge'", 'tiny', 'small', 'paper'),
    'simulate -o new --scenario tiny --seed -1': ('--seed', '-1'),
    'simulate -o new --scenario tiny --clock-error -0.5': (
        '--clock-error: -0.5 s changes no result',),
    'simulate -o new --scenario tiny --focal-drift 100': (
        '--focal-drift, --alignment-drift: need --date',),
    'simulate -o new --scenario tiny --date 1905-05-15': ('--date: not within 1990 to 2037',),
    'simulate -o new --scenario tiny --date soon': ("'soon' is not a time",),
    'simulate -o notes.txt/bag --scenario tiny': ('notes.txt',),
    'import --channel grene': ("'grene'", 'green'),
    'import --images night/0.png --attitude none.csv -o new --camera none.yaml': ('none.yaml',),
    '{import} *.nothing': ('no such files',),
    '{import} 0.fits --attitude none.aem': ('cannot be read',),
    '{import} 0.fits --attitude a.aem 0.fits': ('one file, unless all are SPICE',),
    '{import} 0.fits --camera a.aem': ('a.aem',),
    '{import} 0.fits --star-tracker ST7': ('choose one with',),
    '{import} 0.fits --value-range 5 1': ('is empty',),
    '{import} 0.fits --camera camera.yaml --more-star-trackers ST-2': (
        '--alignment: 0 numbers, 8 are needed: x y z w for each star tracker; only that of a ',),
    'trend none -o new': ('no such folder',),
    'trend nothing -o begun': ('no calibration.json below it',),
    'trend nowhere://fleet -o new': ('nowhere',),
    'play': ('BAG',),
    'play none.mcap': ('none.mcap', 'no such file or folder'),
    'play a.mcap --observer=ground': ('--observer=ground (see starcal play --help)',),
    'play {bag} --rate -1': ('--rate', '-1'),
    'play {bag} --rate nan': ('--rate', 'nan'),
    'play {bag} --remap image': ('--remap', "'image'"),
    'monitor': ('--once', 'not a terminal'),
    'monitor --once nan': ('--once', 'nan'),
}  # fmt: skip
"""
Command lines by `KEYS`, and the words of their refusals.

In ``begun`` may be the record of a failure, or nothing; nowhere else is anything written.
"""


@pytest.fixture(scope='module')
def inputs(tmp_path_factory: pytest.TempPathFactory, tiny_products: Path) -> Path:
    folder = tmp_path_factory.mktemp('inputs')
    (folder / 'products').symlink_to(tiny_products)
    for name in ('params.yaml', 'camera.yaml'):
        shutil.copy(TINY / name, folder)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    for name in ('nothing', 'cut'):
        (folder / name).mkdir()
    (folder / 'notes.txt').write_text('in the way')
    (folder / 'nothing/notes.txt').write_text('notes')
    (folder / 'cut/001.fits').write_bytes(b'SIMPLE  =                    T')
    write_pngs(folder / 'night', frames_of(3))
    write_fits(folder / '0.fits', images()[0])
    write_aem(folder / 'a.aem')
    write_tiny(folder / 'night.mcap', images()[:3], ())
    with BagWriter(folder / 'colour.mcap') as writer:
        for image in images()[:3]:
            colour = np.repeat((image.pixels >> 4).astype(np.uint8).reshape(-1), 3)
            write_encoded(writer, '/opnav/image_raw', image, 'rgb8', colour)
            attitude = np.array([0, 0, 0, 1.0])
            writer.write_attitude('/star_tracker/attitude', image.time_ns, attitude, 'icrf')
    with BagWriter(folder / 'two.mcap') as writer:
        writer.write_image('/image', Image(5, np.full((512, 640), 33, np.uint16)), 'camera')
        writer.write_attitude('/attitude', 5, np.array([0.0, 0.0, 0.0, 1.0]), 'icrf')
        for topic in ('/lens', '/box'):
            writer.write_temperature(topic, 5, 20.0, 'camera')
    with BagWriter(folder / 'observations.mcap') as writer:
        writer.write_observations('/observations', refused_image(1, 8, 8, 'blank', ''), 'camera')
    return folder


def files_in(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob('*')) if 'begun' not in path.parts]


@pytest.mark.usefixtures('forked_readers')
@pytest.mark.parametrize('line', WRONG)
def test_a_mistake_ends_in_one_line_and_writes_nothing(line, inputs, starcal, monkeypatch) -> None:
    monkeypatch.chdir(inputs)
    before = files_in(inputs)
    answer = starcal(*shlex.split(line.format(**KEYS)))
    assert_refused(answer, *WRONG[line])
    assert not answer.out
    assert answer.err.lower().count('one channel') == 0  # no second remedy for colour
    assert files_in(inputs) == before
    assert (inputs / 'notes.txt').read_text() == 'in the way'
