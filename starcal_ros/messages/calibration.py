"""A calibration to a message and back, and to those that any reader of ROS knows."""

from __future__ import annotations

import math

import numpy as np

from starcal_ros.camera import CameraModel, model_of, ros_fit
from starcal_ros.lens import ros_distortion
from starcal_ros.messages.fields import (
    counts_of_reasons,
    flat_array,
    make_header,
    make_time,
    quaternion_from_message,
    quaternion_to_message,
    shaped_array,
    stamp_ns,
    vector_to_message,
)
from starcal_ros.messages.types import (
    ALIGNMENT_TYPE,
    CALIBRATION_TYPE,
    CAMERA_INFO_TYPE,
    Make,
    Message,
)
from starcal_ros.records import (
    ALIGNMENT_NAMES,
    Calibration,
    CameraGeometry,
    Correlation,
    DetectorMaps,
    GateCheck,
    Halves,
    Removal,
    Thermal,
)

_NOT_CHECKED = -1  # in gate_kept
_REMOVAL_COLUMNS = ('significance', 'wald', 'chi2_rise', 'residual_rms_px', 'map_change_px')


def calibration_to_message(calibration: Calibration, make: Make) -> Message:
    """Return a starcal/Calibration, every number as the record has it."""
    camera = calibration.geometry.camera
    fx, skew, fy, cx, cy = (float(value) for value in camera.intrinsics)
    return make(
        CALIBRATION_TYPE,
        header=make_header(calibration.time_ns, calibration.child_frame, make),
        accepted=calibration.accepted,
        reasons=list(calibration.reasons),
        forced=calibration.forced,
        **_halves_fields(calibration.halves),
        **_gate_fields(calibration.gate),
        number=calibration.number,
        in_force_since=make_time(calibration.in_force_since_ns, make),
        first_image=make_time(calibration.first_image_ns, make),
        width=camera.width,
        height=camera.height,
        fx=fx,
        skew=skew,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=flat_array(camera.distortion, np.float64),
        parent_frame=calibration.parent_frame,
        alignment=quaternion_to_message(calibration.geometry.star_tracker_from_camera_xyzw, make),
        parameter_names=list(calibration.parameter_names),
        covariance=flat_array(calibration.covariance, np.float64),
        method=calibration.method,
        estimated=list(calibration.estimated),
        residual_rms_px=float(calibration.residual_rms_px),
        variance_factor=float(calibration.variance_factor),
        images_used=calibration.images_used,
        stars_used=calibration.stars_used,
        stars_rejected=calibration.stars_rejected,
        refused_reasons=list(calibration.images_refused),
        refused_counts=flat_array(list(calibration.images_refused.values()), np.uint32),
        alignment_scatter_arcsec=float(calibration.alignment_scatter_arcsec),
        star_tracker_sigma_arcsec=flat_array(calibration.star_tracker_sigma_arcsec, np.float64),
        centroid_scale=float(calibration.centroid_scale),
        centroid_floor_px=float(calibration.centroid_floor_px),
        dropped_catalog_ids=flat_array(calibration.dropped_catalog_ids, np.int64),
        misfit_images_ns=flat_array(calibration.misfit_images_ns, np.int64),
        singular_values=flat_array(calibration.singular_values, np.float64),
        weakest_direction=calibration.weakest_direction,
        **_thermal_fields(calibration.thermal),
        **_maps_fields(calibration.maps),
        **_correlation_fields(calibration.correlation),
        **_removal_fields(calibration.removals),
        zero_skew_cost_px=float(calibration.zero_skew_cost_px),
        iterations=calibration.iterations,
        termination=calibration.termination,
        provenance_keys=list(calibration.provenance),
        provenance_values=list(calibration.provenance.values()),
    )


def calibration_from_message(message: Message) -> Calibration:
    """
    Calibration of a starcal/Calibration.

    Raises
    ------
    ValueError
        When the message does not hold a camera: an empty one, say.
    """
    names = tuple(str(name) for name in message.parameter_names)
    if names[-3:] != ALIGNMENT_NAMES:
        raise ValueError(f'parameter_names: {", ".join(names) or "none"} do not end in alignment')
    model = model_of(names[:-3])
    intrinsics = [message.fx, message.skew, message.fy, message.cx, message.cy]
    camera = CameraModel(
        int(message.width), int(message.height), np.r_[intrinsics, message.distortion], model
    )
    alignment = quaternion_from_message(message.alignment)
    if not abs(np.linalg.norm(alignment) - 1.0) < 1e-6:  # what rounding to a text could leave
        raise ValueError(f'alignment: {alignment.tolist()} is not a unit quaternion')
    provenance = zip(message.provenance_keys, message.provenance_values, strict=True)
    return Calibration(
        time_ns=stamp_ns(message.header.stamp),
        geometry=CameraGeometry(camera, alignment),
        covariance=shaped_array('covariance', message.covariance, (len(names), len(names))),
        method=str(message.method),
        estimated=tuple(str(name) for name in message.estimated),
        residual_rms_px=float(message.residual_rms_px),
        variance_factor=float(message.variance_factor),
        images_used=int(message.images_used),
        images_refused=counts_of_reasons(message.refused_reasons, message.refused_counts),
        stars_used=int(message.stars_used),
        stars_rejected=int(message.stars_rejected),
        alignment_scatter_arcsec=float(message.alignment_scatter_arcsec),
        star_tracker_sigma_arcsec=tuple(float(s) for s in message.star_tracker_sigma_arcsec),
        centroid_scale=float(message.centroid_scale),
        centroid_floor_px=float(message.centroid_floor_px),
        dropped_catalog_ids=tuple(int(i) for i in message.dropped_catalog_ids),
        misfit_images_ns=tuple(int(t) for t in message.misfit_images_ns),
        singular_values=tuple(float(s) for s in message.singular_values),
        weakest_direction=str(message.weakest_direction),
        zero_skew_cost_px=float(message.zero_skew_cost_px),
        iterations=int(message.iterations),
        termination=str(message.termination),
        accepted=bool(message.accepted),
        reasons=tuple(str(reason) for reason in message.reasons),
        parent_frame=str(message.parent_frame),
        child_frame=str(message.header.frame_id),
        provenance={str(key): str(value) for key, value in provenance},
        thermal=_thermal_from_message(message),
        maps=_maps_from_message(message),
        correlation=_correlation_from_message(message),
        removals=_removals_from_message(message),
        first_image_ns=stamp_ns(message.first_image),
        number=int(message.number),
        in_force_since_ns=stamp_ns(message.in_force_since),
        forced=bool(message.forced),
        halves=_halves_from_message(message),
        gate=_gate_from_message(message),
    )


def _maps_fields(maps: DetectorMaps | None) -> dict[str, object]:
    maps = maps or DetectorMaps(np.empty((0, 0), np.int64), np.empty((0, 0)), np.empty((0, 0)))
    coverage_rows, coverage_cols = maps.stars.shape
    map_rows, map_cols = maps.line_of_sight_sigma_arcsec.shape
    return {
        'coverage_rows': coverage_rows,
        'coverage_cols': coverage_cols,
        'coverage': flat_array(maps.stars, np.uint32),
        'map_rows': map_rows,
        'map_cols': map_cols,
        'line_of_sight_sigma_arcsec': flat_array(maps.line_of_sight_sigma_arcsec, np.float64),
        'shape_sigma_arcsec': flat_array(maps.shape_sigma_arcsec, np.float64),
    }


def _maps_from_message(message: Message) -> DetectorMaps | None:
    if not getattr(message, 'coverage_rows', 0):
        return None
    cells = (int(message.coverage_rows), int(message.coverage_cols))
    grid = (int(message.map_rows), int(message.map_cols))
    return DetectorMaps(
        shaped_array('coverage', message.coverage, cells).astype(np.int64),
        shaped_array('line_of_sight_sigma_arcsec', message.line_of_sight_sigma_arcsec, grid),
        shaped_array('shape_sigma_arcsec', message.shape_sigma_arcsec, grid),
    )


def _removal_fields(removals: tuple[Removal, ...]) -> dict[str, object]:
    stds = np.array([removal.residual_std_px for removal in removals]).reshape(-1, 2)
    columns = {
        f'removal_{name}': flat_array([getattr(removal, name) for removal in removals], np.float64)
        for name in _REMOVAL_COLUMNS
    }
    return {
        'removal_removed': [removal.removed for removal in removals],
        'removal_within_chance': flat_array([r.within_chance for r in removals], np.uint8),
        'removal_residual_std_u_px': flat_array(stds[:, 0], np.float64),
        'removal_residual_std_v_px': flat_array(stds[:, 1], np.float64),
        **columns,
    }


def _removals_from_message(message: Message) -> tuple[Removal, ...]:
    names = [str(name) for name in getattr(message, 'removal_removed', ())]
    if not names:
        return ()
    fields = (*_REMOVAL_COLUMNS, 'residual_std_u_px', 'residual_std_v_px', 'within_chance')
    columns = {
        field: shaped_array(
            f'removal_{field}', getattr(message, f'removal_{field}'), (len(names),)
        ).tolist()
        for field in fields
    }
    return tuple(
        Removal(
            removed=name,
            within_chance=bool(columns['within_chance'][k]),
            residual_std_px=(columns['residual_std_u_px'][k], columns['residual_std_v_px'][k]),
            **{field: columns[field][k] for field in _REMOVAL_COLUMNS},
        )
        for k, name in enumerate(names)
    )


def _correlation_fields(correlation: Correlation | None) -> dict[str, object]:
    correlation = correlation or Correlation((), np.empty((0, 0)))
    return {
        'correlation_names': list(correlation.names),
        'correlation': flat_array(correlation.matrix, np.float64),
    }


def _correlation_from_message(message: Message) -> Correlation | None:
    names = tuple(str(name) for name in getattr(message, 'correlation_names', ()))
    if not names:
        return None
    matrix = shaped_array('correlation', message.correlation, (len(names), len(names)))
    return Correlation(names, matrix)


def _halves_fields(halves: Halves | None) -> dict[str, object]:
    halves = halves or Halves(-1.0, -1.0, -1.0, -1.0)
    return {
        'halves_shape_px': float(halves.shape_px),
        'halves_shape_chance': float(halves.shape_chance),
        'halves_turn_arcsec': float(halves.turn_arcsec),
        'halves_chance': float(halves.chance),
    }


def _halves_from_message(message: Message) -> Halves | None:
    # Recordings of before the field was there have none.
    if not getattr(message, 'halves_chance', -1.0) >= 0:
        return None
    return Halves(
        shape_px=float(message.halves_shape_px),
        shape_chance=float(message.halves_shape_chance),
        turn_arcsec=float(message.halves_turn_arcsec),
        chance=float(message.halves_chance),
    )


def _gate_fields(checks: tuple[GateCheck, ...]) -> dict[str, object]:
    return {
        'gate_name': [check.name for check in checks],
        'gate_option': [check.option for check in checks],
        'gate_found': flat_array([check.found for check in checks], np.float64),
        'gate_limit': flat_array([check.limit for check in checks], np.float64),
        'gate_unit': [check.unit for check in checks],
        'gate_kept': flat_array(
            [_NOT_CHECKED if check.kept is None else check.kept for check in checks], np.int8
        ),
        'gate_note': [check.note for check in checks],
    }


def _gate_from_message(message: Message) -> tuple[GateCheck, ...]:
    # Recordings of before the field was there have none.
    if not len(getattr(message, 'gate_name', ())):
        return ()
    columns = zip(
        message.gate_name,
        message.gate_option,
        message.gate_found,
        message.gate_limit,
        message.gate_unit,
        message.gate_kept,
        message.gate_note,
        strict=True,
    )
    return tuple(
        GateCheck(
            str(name),
            str(option),
            float(found),
            float(limit),
            str(unit),
            None if kept == _NOT_CHECKED else bool(kept),
            str(note),
        )
        for name, option, found, limit, unit, kept, note in columns
    )


def _thermal_fields(thermal: Thermal | None) -> dict[str, object]:
    thermal = thermal or Thermal(math.nan)
    return {
        'reference_temperature_degc': float(thermal.reference_degc),
        'focal_per_degc': flat_array(thermal.focal_per_degc, np.float64),
        'focal_per_degc_sigma': flat_array(thermal.focal_sigma, np.float64),
        'alignment_rate_rad_per_degc': flat_array(thermal.alignment_rate_rad_per_degc, np.float64),
        'alignment_rate_rad_per_degc_sigma': flat_array(thermal.alignment_rate_sigma, np.float64),
        'temperature_note': thermal.note,
    }


def _thermal_from_message(message: Message) -> Thermal | None:
    reference_degc = float(getattr(message, 'reference_temperature_degc', math.nan))
    if math.isnan(reference_degc):
        return None
    q, axes = len(message.focal_per_degc), len(message.alignment_rate_rad_per_degc)
    if axes not in (0, 3):
        raise ValueError(f'alignment_rate_rad_per_degc: {axes} numbers, not 3 or none')
    focal = shaped_array('focal_per_degc', message.focal_per_degc, (q,))
    focal_sigma = shaped_array('focal_per_degc_sigma', message.focal_per_degc_sigma, (q,))
    rate = shaped_array(
        'alignment_rate_rad_per_degc', message.alignment_rate_rad_per_degc, (axes,)
    )
    rate_sigma = shaped_array(
        'alignment_rate_rad_per_degc_sigma', message.alignment_rate_rad_per_degc_sigma, (axes,)
    )
    return Thermal(
        reference_degc=reference_degc,
        focal_per_degc=tuple(focal.tolist()),
        focal_sigma=tuple(focal_sigma.tolist()),
        alignment_rate_rad_per_degc=tuple(rate.tolist()),
        alignment_rate_sigma=tuple(rate_sigma.tolist()),
        note=str(message.temperature_note),
    )


def camera_info_to_message(calibration: Calibration, make: Make) -> Message:
    """
    Return a sensor_msgs/CameraInfo: the best camera without skew.

    Skew does not fit: readers of camera_info take K[0,1] as 0 without a word.
    """
    camera, _ = ros_fit(calibration.geometry.camera)
    fx, _, fy, cx, cy = camera.intrinsics
    distortion_model, D = ros_distortion(camera.model, camera.distortion)
    return make(
        CAMERA_INFO_TYPE,
        header=make_header(calibration.time_ns, calibration.child_frame, make),
        height=camera.height,
        width=camera.width,
        distortion_model=distortion_model,
        d=D,
        k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        r=np.eye(3).ravel(),
        p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
        binning_x=0,
        binning_y=0,
        roi=make(
            'sensor_msgs/msg/RegionOfInterest',
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        ),
    )


def alignment_to_message(calibration: Calibration, make: Make) -> Message:
    """Return a geometry_msgs/TransformStamped: the camera frame in the star tracker frame."""
    return make(
        ALIGNMENT_TYPE,
        header=make_header(calibration.time_ns, calibration.parent_frame, make),
        child_frame_id=calibration.child_frame,
        transform=make(
            'geometry_msgs/msg/Transform',
            translation=vector_to_message(np.zeros(3), make),
            rotation=quaternion_to_message(
                calibration.geometry.star_tracker_from_camera_xyzw, make
            ),
        ),
    )
