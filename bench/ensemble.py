# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Information lost by keeping 60 of 359 images.

Sixty images have less information than 359.  The convex relaxation of the choice (weights of 0 to
1 with sum sixty) is a lower bound for the variance from any sixty of them.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses

import numpy as np

from bench.competitors import make_ensemble
from bench.table import Table
from bench.trials import rms
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import scenario
from starcal_ros.arrays import Floats
from starcal_ros.assessment.observability import (
    image_information,
    keep_most_informative,
    predicted_sigma,
)
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import CameraGeometry, Ensemble

TARGET = 1.05
RANDOM_CHOICES = 200
_STEPS = 400  # of Frank-Wolfe: a gap of some 0.1 %


def stream(ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions) -> Ensemble:
    """Images kept from a stream, as in the calibrator."""
    kept = Ensemble()
    for image in ensemble.images:
        kept = keep_most_informative(kept.add(image), prior, options)
    return kept


def least_mean_variance(information: Floats, count: int, unit: Floats) -> float:
    """
    Lower bound of the mean variance from ``count`` of the images (m, k, k), in ``unit`` (k,)^2.

    A-optimal design, relaxed to weights: convex, so a tangent at any weights is a lower bound.
    Frank-Wolfe: the minimum of a tangent is a choice of ``count`` whole images.
    """
    scaled = information * unit[:, None] * unit[None, :]
    weight = np.full(len(scaled), count / len(scaled))
    best = 0.0
    for step in range(_STEPS):
        inverse = np.linalg.inv(np.einsum('m,mij->ij', weight, scaled))
        gradient = -np.einsum('ij,mjk,ki->m', inverse, scaled, inverse)
        least = np.argsort(gradient)[:count]
        tangent = np.trace(inverse) - gradient @ weight + gradient[least].sum()
        best = max(best, float(tangent))
        vertex = np.zeros(len(scaled))
        vertex[least] = 1.0
        weight += (vertex - weight) * 2.0 / (step + 2.0 + count)
    return best / len(unit)


def measure(
    title: str, ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Table:
    """Rms and worst sigma of choices of ``max_images``, relative to all and to the best choice."""
    m, count = len(ensemble.images), options.max_images
    everything = predicted_sigma(ensemble, prior, options)
    information = image_information(ensemble.images, prior, options)
    least = np.sqrt(least_mean_variance(information, count, everything))
    columns = 'images, choice, sigma by all, worst, by sqrt(count), by best possible, target'
    table = Table(
        title,
        columns.split(', '),
        notes=[
            f'sigma by all: rms over {len(everything)} unknowns of sigma over that of all images.',
            f'by sqrt(count): the same, over sqrt({m}/{count}), that of images all alike.',
            'best possible: a lower bound of the rms, by convex relaxation of the choice.',
        ],
    )
    rng = np.random.default_rng(1)
    chosen = [rng.choice(m, count, replace=False) for _ in range(RANDOM_CHOICES)]
    at_random = [np.sqrt(np.diag(np.linalg.inv(information[rows].sum(axis=0)))) for rows in chosen]
    streamed = stream(ensemble, prior, options)
    at_once = keep_most_informative(ensemble, prior, options)
    choices = {
        'all': everything,
        'streamed, one by one': predicted_sigma(streamed, prior, options),
        'from all at once': predicted_sigma(at_once, prior, options),
        f'best of {RANDOM_CHOICES} at random': min(at_random, key=lambda s: rms(s / everything)),
        'at random, mean': np.mean(at_random, axis=0),
    }
    for name, sigma in choices.items():
        ratio, images = sigma / everything, m if name == 'all' else count
        by_best = rms(ratio) / least
        judged = ''
        if 'streamed' in name:
            judged = f'<= {TARGET:g}: ' + ('met' if by_best <= TARGET else 'MISSED')
        by_count = rms(ratio) / np.sqrt(m / images)
        ratios = (rms(ratio), float(ratio.max()), by_count, None if images == m else by_best)
        table.add(images, name, *ratios, judged)
    return table


def run(quick: bool) -> Iterator[Table]:
    """Run images of the whole sky, and of one hour of the night of the paper."""
    m, count = (30, 8) if quick else (359, 60)
    options = CalibrationOptions(star_tracker_sigma_arcsec=(20.0, 20.0, 20.0), max_images=count)
    whole_sky, prior = make_ensemble(m)
    night = dataclasses.replace(scenario('paper'), image_count=m, magnitude_limit=6.65)
    yield measure(f'{count} of {m} images over the whole sky', whole_sky, prior, options)
    hour = true_observations(night)
    yield measure(f'{count} of {m} images of one hour', hour, night.prior, options)
