# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The list of unknowns: which there are, what a step moves, and a row that adds one."""

import dataclasses
import math

from four_images import (  # type: ignore[import-not-found]
    ASSUMED,
    CAMERA,
    HEIGHT,
    IMAGES,
    octaves,
    OWN,
    shared_steps,
    Small,
    small,
    TURN_S,
    WIDTH,
)
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import eval_jacobi
from worlds import each_image, estimated, observed  # type: ignore[import-not-found]

from starcal_ground.planning.plan import prospect, target
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats, Indices
from starcal_ros.assessment.budget import sigma_budget, statements
from starcal_ros.assessment.gate import GateOptions, model_gate
from starcal_ros.assessment.model_checks import model_checks
from starcal_ros.assessment.remedies import remedy_against
from starcal_ros.camera import CameraModel, project, rotation_jacobian
from starcal_ros.camera.lens import LENSES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation import unknowns
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.equations import tracker_turns
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import attitude_errors, turn_derivatives
from starcal_ros.estimation.tracker_errors import Rates
from starcal_ros.estimation.unknowns import (
    Assumptions,
    EntryInputs,
    Kind,
    Layout,
    moved,
    PriorTest,
    Unknown,
    unknowns_in_state,
    unknowns_of,
)
from starcal_ros.records import Ensemble, GateCheck, StarObservations


@pytest.mark.parametrize('model', ['plumb_bob', 'equidistant'])
def test_lateral_colour_is_a_change_of_the_focal_length(model: str) -> None:
    centre_px, angle = np.array([600.0, 400.0]), np.linspace(0.0, 1.2, 7)
    parameters = np.r_[[900.0, 0.0, 900.0], centre_px, np.zeros(len(LENSES[model].coefficients))]
    camera = CameraModel(WIDTH, HEIGHT, parameters, model)
    e = np.stack([0.8 * np.sin(angle), 0.6 * np.sin(angle), np.cos(angle)], axis=1)
    turns = unknowns._by_scale(model, e.T, e.T, np.zeros(7, np.int64))[:, 0]
    moved_px = np.einsum('nab,bn->na', rotation_jacobian(camera, e), turns)
    # Without distortion, all that the focal length changes is the distance from the centre.
    assert moved_px == pytest.approx(project(camera, e) - centre_px, abs=1e-9)


def test_labels_have_a_name_and_a_unit_for_each_unknown(given: Small) -> None:
    layout = given.layout
    assert len(set(layout.labels)) == layout.count == len(layout.labels)
    assert layout.labels[:10] == CAMERA.parameter_names
    assert layout.labels[10:12] == ('focal_temperature_1', 'focal_temperature_2')
    assert layout.labels[layout.places['stamps']] == ('stamp_offset_s',)
    assert layout['velocity'].labels[1] == 'velocity_y_m_s'


def test_octaves_are_of_wavelengths_down_to_a_width_its_half_and_its_quarter(given) -> None:
    entry = given.layout['field']
    assert entry.octave is not None and np.array_equal(entry.octave, octaves(given))
    # All cosines down to a quarter of the width but the constant, for u and for v.
    most = 12
    i, j = np.meshgrid(np.arange(most), np.arange(2 * most), indexing='ij')
    waves = np.hypot(i / 2.7, j * WIDTH / (2.7 * HEIGHT))
    assert len(entry) == 2 * (np.count_nonzero(waves <= 4.0) - 1)
    assert {'field_9_0_u_px', 'field_0_6_v_px', 'field_1_0_v_px'} <= set(entry.labels)


def test_the_field_has_the_next_radial_term_of_a_lens_free_of_lower_ones(given: Small) -> None:
    entry = given.layout['field']
    assert entry.functions is not None and entry.term is not None
    u, v = (size * (np.arange(60) + 0.5) / 60 - 0.5 for size in (WIDTH, HEIGHT))
    grid = np.stack([np.repeat(u, 60), np.tile(v, 60)])
    found = entry.term.reshape(2, -1) @ entry.functions(grid)
    x = 2.0 * (grid + 0.5) - np.array([[WIDTH], [HEIGHT]])
    x /= math.hypot(WIDTH, HEIGHT)
    r = np.linalg.norm(x, axis=0)
    jacobi = eval_jacobi(4, 0.0, 1.0, 2.0 * r**2 - 1.0)  # R_9^1(r) / r, as Zernike's are defined
    term = x * jacobi / np.sqrt(((x * jacobi) ** 2).mean())
    # Of the steep rise in the corners three octaves hold little: a fifth of the term.
    off = np.sqrt(((found - term) ** 2).mean())
    assert off < 0.25 and np.sqrt(((found - term)[:, r < 0.9] ** 2).mean()) < off
    assert np.sqrt((found**2).mean()) == pytest.approx(1.0, abs=0.1)


def test_what_is_not_assumed_or_not_known_is_no_unknown() -> None:
    given = small(terms=False, two_trackers=False)
    size, rates_rad_s = (WIDTH, HEIGHT), given.rates.rad_s

    def layout_of(rates_rad_s: Floats, assumed: Assumptions) -> Layout:
        root = (1e-3 if np.isnan(rates_rad_s).all() else 0.0) * np.eye(3)
        rates = Rates(rates_rad_s, np.tile(root, (IMAGES, 1, 1)), TURN_S)
        return unknowns_of(EntryInputs(given.problem, given.state, rates, size, assumed))

    still, unknown = np.zeros((IMAGES, 3)), np.full((IMAGES, 3), np.nan)
    one = still.copy()
    one[2, 1] = 1e-5
    for rates, assumed, more in (
        (rates_rad_s, Assumptions(0.0, (0.004, 0.0), 0.0), []),
        (rates_rad_s, Assumptions(0.0, (0.0, 0.0), 0.1), ['stamps']),
        (rates_rad_s, Assumptions(0.0, (0.0, 0.1), 0.0), ['readout']),
        (still, ASSUMED, ['velocity']),
        (one, ASSUMED, ['velocity', 'readout', 'stamps']),
        # No rate is known: turns over the read-out by one that all images may have.
        (unknown, ASSUMED, ['velocity', 'readout', 'stamps']),
        (unknown, Assumptions(0.0, (0.0, 0.0), 0.0), []),
        (unknown, Assumptions(0.0, (0.0, 0.02), 0.005), ['readout', 'stamps']),
    ):
        names = [e.name for e in layout_of(rates, assumed).entries]
        assert names == ['camera', 'alignment', *more, 'field', 'shape']
    late = layout_of(unknown, Assumptions(0.0, (0.0, 0.02), 0.005))
    assert late['stamps'].sigma == pytest.approx(np.full(3, 0.005 * 1e-3))
    assert late['stamps'].tracker == pytest.approx(np.tile(np.eye(3), (IMAGES, 1, 1)))
    readout = layout_of(unknown, ASSUMED)['readout']
    assert readout.sigma == pytest.approx(np.full(3, math.hypot(0.004, 0.02) * 1e-3))
    assert not readout.offset.any() and readout.turn is not None
    pixels = np.array([[3.0, 3.0], [-0.5, HEIGHT - 0.5]])
    turns = readout.turn(pixels, np.zeros((3, 2)), np.array([0, 2]))
    assert turns.transpose(2, 0, 1) == pytest.approx(np.stack([-0.5 * np.eye(3), 0.5 * np.eye(3)]))


def test_a_step_moves_pixels_and_attitudes_as_the_unknowns_do(given: Small) -> None:
    rng = np.random.default_rng(1)
    layout = unknowns_in_state(given.problem, given.state)
    x, y = np.zeros(given.layout.count), np.zeros((IMAGES, OWN))
    at = given.layout.of([e.name for e in layout.entries])
    x[at] = 1e-2 * shared_steps(given)[at] * rng.normal(size=len(at))
    y[:, :3] = 1e-6 * rng.normal(size=(IMAGES, 3))
    state = moved(given.problem, given.state, layout, x[at], y[:, :3])
    after = dataclasses.replace(given, state=state)
    zero = np.zeros(given.layout.count), np.zeros((IMAGES, OWN))
    change = given.pixels(x, y) - given.predicted_px
    # Products of two small rotations remain: 1e-12 of a radian.
    assert after.predicted_px - given.predicted_px == pytest.approx(change, abs=1e-7)
    assert np.abs(change).max() > 1e-3
    expected = given.tracker_errors(x, y)
    assert after.tracker_errors(*zero) == pytest.approx(expected, abs=1e-11)
    errors = attitude_errors(given.problem, state, state.camera_from_icrf)
    assert errors == pytest.approx(expected, abs=1e-11)


def test_the_camera_follows_a_large_turn_of_the_alignment(given: Small) -> None:
    layout = unknowns_in_state(given.problem, given.state)
    x = np.zeros(layout.count)
    x[layout.of(['alignment'])] = [0.3, -0.2, 0.5]
    at, turns = tracker_turns(layout)
    state = moved(given.problem, given.state, layout, x, turns @ x[at])
    before = attitude_errors(given.problem, given.state, given.state.camera_from_icrf)
    after = attitude_errors(given.problem, state, state.camera_from_icrf)
    assert after == pytest.approx(before, abs=1e-14)
    assert np.array_equal(state.parameters, given.state.parameters)


def test_a_step_turns_a_turned_camera_by_its_derivative() -> None:
    turn, step = np.array([0.9, -0.4, 0.7]), 1e-6  # products of two steps remain
    turned = Rotation.from_rotvec(-turn - step * np.eye(3)) * Rotation.from_rotvec(turn)
    found = turn_derivatives(turn[None])[0]
    assert found == pytest.approx(-turned.as_rotvec().T / step, abs=2 * step)


MASS_ICRF = np.array([0.6, 0.8, 0.0])
TRUE_ARCSEC = 2.0  # at 90 degrees five hundred times the Sun's: a few images show it


def row(sigma_arcsec: float) -> Kind:
    """The deflection of light by a mass: stars move away from it."""

    def make(given: EntryInputs) -> Unknown:
        def turn(_: Floats, directions: Floats, image: Indices) -> Floats:
            mass = np.einsum('mij,j->im', given.camera_from_icrf, MASS_ICRF)[:, image]
            turns = np.cross(directions, mass, axis=0) / (1.0 - (mass * directions).sum(axis=0))
            return np.asarray(ARCSECOND_RAD * turns[:, None])

        sigma = np.array([sigma_arcsec])
        return Unknown('mass', ('deflection_arcsec',), sigma, np.zeros(1), turn=turn)

    return Kind(
        make,
        cause='light by a mass',
        assumption=lambda layout, *_: f'{layout["mass"].sigma[0]:g} arcsec assumed',
        option=lambda *_: ('deflection_arcsec', 'known', 0.0),
        needs_dates=True,
        remedy='point away from the mass',
        tested=PriorTest(('deflection',), 'state the mass', is_added=True),
    )


def deflected() -> tuple[Scenario, Ensemble]:
    """A campaign whose catalog has the stars where they were without the mass."""
    made, ensemble = observed(3)

    def moved(_: int, image: StarObservations) -> dict[str, Floats]:
        e = image.direction_icrf
        cosine = (e @ MASS_ICRF)[:, None]
        e = e - TRUE_ARCSEC * ARCSECOND_RAD * (e * cosine - MASS_ICRF) / (1.0 - cosine)
        return {'direction_icrf': e / np.linalg.norm(e, axis=1, keepdims=True)}

    return made, each_image(ensemble, moved)


def solved(monkeypatch: pytest.MonkeyPatch, sigma_arcsec: float) -> Estimate:
    monkeypatch.setitem(unknowns.UNKNOWNS, 'mass', row(sigma_arcsec))
    return estimated(*deflected())  # type: ignore[no-any-return]


def test_an_unknown_is_added_by_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is estimated and planned for, its cause is in the budget, and its prior is tested."""
    found, options = solved(monkeypatch, 3.0), CalibrationOptions()
    layout, at = found.linear.layout, found.linear.layout.of(['mass'])
    assert layout.field_at[-1] == layout.count - 1  # the field stays the last
    error = found.posterior.mean[at].item() - TRUE_ARCSEC
    sigma = float(found.posterior.covariance[at, at].item()) ** 0.5
    # By chance a normal error is beyond four sigma in one of 16,000.
    assert abs(error) < 4.0 * sigma < 0.1 * TRUE_ARCSEC
    parts = {part.cause: part for part in sigma_budget(found, options)}
    part, total = parts['light by a mass'], parts['total']
    assert part.assumption == '3 arcsec assumed'
    assert 0.0 < part.map_arcsec < total.map_arcsec
    assert remedy_against(part.cause) == 'point away from the mass'
    # If the whole sigma came from it, none would be left where the option is stated.
    both = total, dataclasses.replace(total, cause=part.cause)
    (row,) = statements(both, found, options)
    assert (row.option, row.after_arcsec) == ('deflection_arcsec', 0.0)
    (undated,) = statements(both, found, options, has_dates=False)
    assert undated.option == 'deflection_arcsec (and dates: the images have none)'
    assert check_of(found).passed
    wanted, (_, ensemble) = target(found, 'deflection_arcsec'), deflected()
    now, after = prospect(found, ensemble.images[:1], options).variances([0], wanted.squares)
    assert after < now == pytest.approx(sigma**2)


def test_the_check_of_a_prior_of_an_added_unknown_names_its_remedy(monkeypatch) -> None:
    check = check_of(solved(monkeypatch, 0.1))
    assert check.passed is False
    assert check.note.startswith('the stars add 2.') and check.note.endswith('; state the mass')


def check_of(found: Estimate) -> GateCheck:
    checks = model_gate(model_checks(found), GateOptions())
    (check,) = (check for check in checks if 'deflection' in check.name)
    return check
