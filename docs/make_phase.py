# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Draw the centroid error against the pixel phase: ``python -m docs.make_phase [FILE]``.

Stars of one brightness at random pixel phases are rendered and measured by both methods; shown are
the mean error for every tenth of a pixel, and the amplitude of its first harmonic.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from starcal_ground.report.svg import Curve, MUTED, plot, SERIES, sheet
from starcal_ground.simulation.rendering import expose, star_electrons
from starcal_ground.simulation.scenario import Detector
from starcal_ros.arrays import Floats
from starcal_ros.records import StarRefusal
from starcal_ros.stars.centroiding import measure_stars
from starcal_ros.stars.detection import detect, measure_background
from starcal_ros.stars.image_model import CentroidOptions, model_image

FILE = Path(__file__).parent / 'images' / 'pixel_phase.svg'
SHAPE = (1024, 1296)
SPACING_PX = 24
IMAGES = 12
FLUXES_ELECTRONS = (6e2, 2e3, 2e4, 4e5)
METHODS = ('psf', 'moment')
BINS = 10


def measure(method: str, flux_electrons: float) -> tuple[Floats, Floats, float]:
    """Errors (n,) in px and phases (n,) of both coordinates of many stars, and the median snr."""
    # 16 bits hold the brightest of them.
    detector = dataclasses.replace(
        Detector(cosmic_rays=0.0, hot_fraction=0.0), bits=16, offset_dn=500.0
    )
    options = CentroidOptions(centroid=method)
    errors, phases, snr = [], [], []
    for seed in range(IMAGES):
        rng = np.random.default_rng([seed, int(flux_electrons)])
        v, u = np.mgrid[SPACING_PX : SHAPE[0] - SPACING_PX : SPACING_PX, 24:1272:SPACING_PX]
        xy = np.stack([u.ravel(), v.ravel()], axis=-1) + rng.uniform(-0.5, 0.5, (u.size, 2))
        light = star_electrons(xy, np.full(len(xy), flux_electrons), detector.psf_sigma_px, SHAPE)
        pixels = expose(light + detector.background_electrons, detector, rng)
        background = measure_background(pixels)
        sources = detect(pixels, background)
        model = model_image(pixels, background, sources, options)
        found = measure_stars(pixels, xy, model, options)
        good = found.refusal == StarRefusal.NONE
        errors.append((found.xy_px - xy)[good].ravel())
        phases.append((xy - np.rint(xy))[good].ravel())
        snr.append(found.snr[good])
    return np.concatenate(errors), np.concatenate(phases), float(np.median(np.concatenate(snr)))


def main() -> None:
    """Draw both methods side by side and print the amplitudes."""
    parser = argparse.ArgumentParser(description='Draw the pixel-phase error of centroids.')
    parser.add_argument('file', nargs='?', type=Path, default=FILE)
    edges = np.linspace(-0.5, 0.5, BINS + 1)
    panels = []
    for method in METHODS:
        curves = []
        for flux, colour in zip(FLUXES_ELECTRONS, (*SERIES, MUTED), strict=False):
            error, phase, snr = measure(method, flux)
            part = np.clip(np.digitize(phase, edges) - 1, 0, BINS - 1)
            count = np.bincount(part, minlength=BINS)
            mean = np.bincount(part, error, minlength=BINS) / count
            sigma = np.sqrt(np.bincount(part, error**2, minlength=BINS)) / count
            middle = 0.5 * (edges[1:] + edges[:-1])
            curves.append(Curve(middle, mean, colour, f'S/N {snr:.0f}', 'circle', sigma=sigma))
            harmonic = 2 * abs(np.mean(error * np.exp(2j * np.pi * phase)))
            noise = 2 * np.sqrt(np.mean(error**2) / len(error))
            print(f'{method:<7} S/N {snr:6.1f}  harmonic {harmonic:.4f} px, noise {noise:.4f} px')
        panels.append(
            plot(curves, 'place of the star in its pixel (px)', 'mean error (px)', title=method,
                 y=(-0.04, 0.05), under=lambda panel: panel.band(-0.01, 0.01))
        )  # fmt: skip
    parser.parse_args().file.write_text(sheet([panels]).document())


if __name__ == '__main__':
    main()
