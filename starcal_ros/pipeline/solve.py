"""From an ensemble to a calibration: collected, solved, and held against the gate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
import math

import numpy as np

from starcal_ros.assessment.agreement import Difference, difference, halves
from starcal_ros.assessment.gate import Candidate, judge, reasons_of
from starcal_ros.assessment.observability import (
    correlation,
    detector_maps,
    keep_most_informative,
    map_sigma_px,
    weakest_direction,
)
from starcal_ros.assessment.observability import ensemble_status as _ensemble_status
from starcal_ros.assessment.residuals import Residuals, residuals_of
from starcal_ros.assessment.term_removal import removal_study
from starcal_ros.camera import ros_fit
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import (
    CalibrationOptions,
    Estimate,
    estimate_calibration,
    estimated_parameters,
)
from starcal_ros.options import check_value
from starcal_ros.pipeline.provenance import provenance_of
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import (
    Calibration,
    Ensemble,
    EnsembleStatus,
    Halves,
    StarObservations,
)


def add_to_ensemble(ensemble: Ensemble, observations: StarObservations, setup: Setup) -> Ensemble:
    """
    Return the ensemble with one more image; at ``max_images`` the least informative goes.

    An image of another size than the prior camera's is counted as refused: its stars are of
    another camera.
    """
    size, camera = (observations.width, observations.height), setup.prior.camera
    if not observations.refusal and size != (camera.width, camera.height):
        observations = dataclasses.replace(observations, refusal='wrong_size')
    return within_limit(ensemble.add(observations), setup)


def within_limit(ensemble: Ensemble, setup: Setup) -> Ensemble:
    """Return the ensemble without its least informative images, down to ``max_images``."""
    return keep_most_informative(ensemble, setup.prior, setup.calibration)


def ensemble_status(ensemble: Ensemble, setup: Setup) -> EnsembleStatus:
    """What has been collected and what a calibration from it would be worth."""
    return _ensemble_status(ensemble, setup.prior, setup.calibration)


def solve(
    ensemble: Ensemble,
    setup: Setup,
    method: str = '',
    estimate: Sequence[str] = (),
    inputs: Mapping[str, str] | None = None,
    in_force: Calibration | None = None,
) -> Calibration:
    """
    A calibration of the ensemble with the verdict of the gate and its provenance.

    ``method`` and ``estimate`` override the options where not empty; ``inputs`` names what the
    observations came from, for the provenance; the gate holds the change against ``in_force``.

    Raises
    ------
    TooFewObservations
        When the ensemble cannot carry it; the text says what is missing.
    OptionError
        For a method or parameter name that is none.
    """
    return solve_with_residuals(ensemble, setup, method, estimate, inputs, in_force)[0]


def solve_with_residuals(
    ensemble: Ensemble,
    setup: Setup,
    method: str = '',
    estimate: Sequence[str] = (),
    inputs: Mapping[str, str] | None = None,
    in_force: Calibration | None = None,
) -> tuple[Calibration, Residuals]:
    """The calibration of `solve`, and what it left over of every star and image."""
    setup = _as_asked_for(setup, method, estimate)
    result = estimate_calibration(ensemble, setup.prior, setup.calibration)
    agreed: Difference | str = 'min_halves_chance is 0'
    if setup.gate.min_halves_chance > 0:
        agreed = halves(ensemble, setup.prior, setup.calibration)
    provenance = provenance_of(setup, ensemble, inputs or {})
    calibration = _not_judged(result, ensemble, setup, _halves_record(agreed), provenance)
    candidate = _candidate(calibration, setup, agreed, _step(in_force, calibration))
    checks = judge(candidate, setup.gate, setup.calibration)
    reasons = reasons_of(checks)
    calibration = dataclasses.replace(
        calibration, gate=checks, reasons=reasons, accepted=not reasons
    )
    colour_bp_rp = setup.catalog.colours_bp_rp(result.table.catalog_id)
    return calibration, residuals_of(result, ensemble, colour_bp_rp)


def _as_asked_for(setup: Setup, method: str, estimate: Sequence[str]) -> Setup:
    """The setup with another method and other parameters to estimate, where they are given."""
    override: dict[str, object] = {}
    if method:
        override['method'] = method
    if estimate:
        override['estimate'] = tuple(estimate)
    for field in dataclasses.fields(CalibrationOptions):
        if field.name in override:
            check_value(field, override[field.name])
    options = dataclasses.replace(setup.calibration, **override)  # type: ignore[arg-type]
    return dataclasses.replace(setup, calibration=options)


def _not_judged(
    result: Estimate,
    ensemble: Ensemble,
    setup: Setup,
    agreed: Halves | None,
    provenance: Mapping[str, str],
) -> Calibration:
    """An estimate with its statistics, as the gate takes it: not accepted yet."""
    kept, camera = result.kept, result.geometry.camera
    singular_values, weakest = weakest_direction(result.information, result.information_names)
    stamps_ns = [image.time_ns for image in ensemble.images]
    return Calibration(
        time_ns=max(stamps_ns),
        first_image_ns=min(stamps_ns),
        geometry=result.geometry,
        covariance=result.covariance,
        method=setup.calibration.method,
        estimated=estimated_parameters(setup.calibration, camera.model),
        residual_rms_px=float(np.sqrt(np.mean(result.residual_px[kept] ** 2))),
        variance_factor=result.variance_factor,
        images_used=len(stamps_ns),
        images_refused=dict(ensemble.refused),
        stars_used=int(kept.sum()),
        stars_rejected=int((~kept).sum()),
        alignment_scatter_arcsec=result.alignment_scatter_arcsec,
        star_tracker_sigma_arcsec=tuple(
            float(sigma) for sigma in result.star_tracker_sigma_rad / ARCSECOND_RAD
        ),
        centroid_scale=result.variance.scale,
        centroid_floor_px=math.sqrt(result.variance.floor_px2),
        dropped_catalog_ids=tuple(result.dropped_catalog_id.tolist()),
        misfit_images_ns=tuple(np.array(stamps_ns)[result.misfit_image].tolist()),
        singular_values=tuple(float(value) for value in singular_values),
        weakest_direction=weakest,
        zero_skew_cost_px=ros_fit(camera)[1],
        iterations=result.iterations,
        termination=result.termination,
        accepted=False,
        reasons=(),
        parent_frame=setup.frames.star_tracker_frame,
        child_frame=setup.frames.camera_frame,
        provenance=provenance,
        thermal=result.thermal,
        maps=detector_maps(camera, result.covariance, result.table.measured_px[kept]),
        correlation=correlation(result.shared_covariance, result.shared_names),
        removals=removal_study(result),
        halves=agreed,
    )


def _halves_record(agreed: Difference | str) -> Halves | None:
    if isinstance(agreed, str):
        return None
    return Halves(
        shape_px=agreed.shape_px,
        shape_chance=agreed.shape_chance,
        turn_arcsec=agreed.turn_rad / ARCSECOND_RAD,
        chance=agreed.chance,
    )


def _step(in_force: Calibration | None, calibration: Calibration) -> Difference | None:
    """From the calibration in force, over what both estimate."""
    if in_force is None:
        return None
    return difference(
        in_force.geometry,
        in_force.covariance,
        calibration.geometry,
        calibration.covariance,
        tuple(name for name in calibration.estimated if name in in_force.estimated),
    )


def _candidate(
    calibration: Calibration,
    setup: Setup,
    agreed: Difference | str,
    step: Difference | None,
) -> Candidate:
    """What the gate looks at of a calibration."""
    maps = calibration.maps
    assert maps is not None  # this module has made them
    given_arcsec = np.array(setup.calibration.star_tracker_sigma_arcsec)
    found_arcsec = np.array(calibration.star_tracker_sigma_arcsec)
    return Candidate(
        geometry=calibration.geometry,
        prior=setup.prior,
        covariance=calibration.covariance,
        residual_rms_px=calibration.residual_rms_px,
        images_used=calibration.images_used,
        images_misfit=len(calibration.misfit_images_ns),
        stars_used=calibration.stars_used,
        stars_rejected=calibration.stars_rejected,
        coverage=maps.stars,
        map_sigma_px=float(
            map_sigma_px(calibration.geometry.camera, calibration.covariance).max()
        ),
        line_of_sight_sigma_arcsec=float(maps.line_of_sight_sigma_arcsec.max()),
        singular_value=calibration.singular_values[-1],
        zero_skew_cost_px=calibration.zero_skew_cost_px,
        star_tracker_excess=float((found_arcsec / given_arcsec).max()),
        termination=calibration.termination,
        halves=agreed,
        step=step,
    )
