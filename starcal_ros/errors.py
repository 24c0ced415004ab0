"""The few exceptions a caller may catch; their text is one line that a person can act on."""

from __future__ import annotations


class StarcalError(Exception):
    """Base of all that starcal raises on purpose for bad input."""


class OptionError(StarcalError):
    """An option is unknown, of the wrong type or out of its range; the text names it."""


class CatalogError(StarcalError):
    """The star catalog file is missing, damaged or not one."""


class BagError(StarcalError):
    """A bag is missing, not a bag, or lacks what was asked of it."""


class ProductError(StarcalError):
    """A calibration file or camera YAML cannot be read back."""


class ArchiveError(StarcalError):
    """The state folder cannot be used, or not be written just now; the text says why."""


class ImageRefused(StarcalError):
    """
    One image cannot be used; the run goes on without it.

    Attributes
    ----------
    reason : str
        Short stable name, counted and published (``records.IMAGE_REFUSALS``).
    detail : str
        What was found, for a person.
    """

    def __init__(self, reason: str, detail: str = '') -> None:
        super().__init__(f'{reason}: {detail}' if detail else reason)
        self.reason = reason
        self.detail = detail


class TooFewObservations(StarcalError):
    """The ensemble cannot carry the calibration asked for; the text says what is missing."""
