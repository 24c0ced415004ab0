"""The origin of an exported calibration, as lines of a comment in ASCII."""

from __future__ import annotations

from starcal_ros.constants import utc_text
from starcal_ros.records import Calibration

PIXEL_CONVENTION = (
    'Pixel (u, v) = (column, row); the centre of the first pixel is (0, 0).',
    'Camera frame: +Z along the optical axis, +X along u, +Y along v.',
)


def origin(calibration: Calibration) -> list[str]:
    """Lines that name software, images, verdict and sources of a calibration."""
    verdict = 'passed' if calibration.accepted else 'failed: ' + '; '.join(calibration.reasons)
    lines = [
        f'Calibration by {calibration.provenance.get("software", "starcal")}',
        f'From {utc_text(calibration.first_image_ns)} to {utc_text(calibration.time_ns)}',
        f'Images: {calibration.images_used}; stars: {calibration.stars_used}',
        f'Residual: {calibration.residual_rms_px:.4f} px rms per axis; gate: {verdict}',
    ]
    for name, value in sorted(calibration.provenance.items()):
        if name not in ('software', 'options', 'prior'):
            lines.append(f'{name}: {value}')
    return [ascii_line(line) for line in lines]


def ascii_line(text: str) -> str:
    """Text in one line of ASCII, as SPICE kernels need it."""
    return ' '.join(text.split()).encode('ascii', 'replace').decode()
