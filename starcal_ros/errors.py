# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Exceptions that a caller may catch; each text is one line that names cause and remedy.

The tool prints it on stderr and ends with status 2, a node logs it::

    starcal: params.yaml: star_tracker_sigma_arcsec: [5e-05, 5e-05, 5e-05] looks like radians: in
    arcseconds it is [10.3, 10.3, 10.3]
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import sys

# Modules of the extras in setup.cfg.
_OF_EXTRAS = ('astropy', 'cryptography', 'dask', 'distributed', 'fsspec', 'rawpy', 'spiceypy')
_OF_STORES = ('adlfs', 'gcsfs', 's3fs')  # the URL decides which of them is needed
# Packages of the plain install that rosdep does not bring, by their names in PyPI.
_NEEDED = {
    'jinja2': 'Jinja2',
    'markupsafe': 'Jinja2',
    'mcap': 'mcap rosbags',
    'PIL': 'Pillow',
    'rosbags': 'mcap rosbags',
}


class StarcalError(Exception):
    """
    Base class of the exceptions that starcal raises for bad input.

    >>> import starcal_ground
    >>> try:
    ...     starcal_ground.calibrate_bag('no.mcap', 'bags/tiny/params.yaml')
    ... except starcal_ground.StarcalError as error:
    ...     print(error)
    no.mcap: no such file or folder
    """


class OptionError(StarcalError):
    """
    An option is unknown, of the wrong type or out of its range; the text names it.

    >>> import starcal_ground
    >>> prior = starcal_ground.read_calibration('out').geometry
    >>> starcal_ground.calibrate([], prior, methd='single')
    Traceback (most recent call last):
    starcal_ros.errors.OptionError: methd: no such parameter (did you mean method?)
    """


class CatalogError(StarcalError):
    """The star catalog file is missing, damaged or of another format."""


class BagError(StarcalError):
    """A bag is missing, not an MCAP bag, or lacks the requested topic."""


class ProductError(StarcalError):
    """A calibration file or a camera YAML file cannot be read."""


class IngestError(StarcalError):
    """A file of a mission cannot be read; the text names file, cause and remedy."""


class NotFromStars(StarcalError):
    """Images without attitudes give no camera; the text names the images to take next."""


class ArchiveError(StarcalError):
    """The state folder cannot be used or cannot be written at present."""


class ImageRefused(StarcalError):
    """
    One image cannot be used; processing continues without it.

    ``reason`` is a name of `records.IMAGE_REFUSALS`, counted and published; ``detail`` explains it
    to the operator.
    """

    def __init__(self, reason: str, detail: str = '') -> None:
        super().__init__(f'{reason}: {detail}' if detail else reason)
        self.reason = reason
        self.detail = detail


class TooFewObservations(StarcalError):
    """
    The ensemble does not suffice for the requested calibration; the text names the shortage.

    >>> import starcal_ground
    >>> prior = starcal_ground.read_calibration('out').geometry
    >>> starcal_ground.calibrate([], prior)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    starcal_ros.errors.TooFewObservations: too few observations: 3 more images (0 of 3...
    """


def missing_package(error: ModuleNotFoundError, extra: str = '') -> str:
    """
    One line with the command that installs a package for this interpreter.

    ``extra`` has it, if it is none of the plain install.  Raises the error where something else is
    missing.
    """
    install = f'{error.name} is not installed: {sys.executable} -m pip install'
    if error.name in _NEEDED:
        return f'{install} {_NEEDED[error.name]}'
    if error.name in _OF_STORES:
        return f'{install} {error.name}'
    if error.name not in _OF_EXTRAS:
        raise error
    return f"{install} '.[{extra}]' in the folder of starcal"


@contextlib.contextmanager
def needing(extra: str, kind: type[StarcalError], place: object) -> Iterator[None]:
    """Raise an import of the block that fails as a kind that names the extra to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise kind(f'{place}: {missing_package(error, extra)}') from error


@contextlib.contextmanager
def errors_as(kind: type[StarcalError], place: object, done: str = 'read') -> Iterator[None]:
    """Raise an OSError or ValueError of the block as another kind that names the file."""
    try:
        yield
    except OSError as error:
        raise kind(f'{place}: cannot be {done}: {error.strerror or error}') from error
    except ValueError as error:
        raise kind(f'{place}: {error}') from error
