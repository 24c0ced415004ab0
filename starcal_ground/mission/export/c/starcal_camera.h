/* Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0 */
/*
 * A camera calibrated by starcal, in C99 (and C++17): pixels to lines of sight and back, with
 * covariance.  No heap, no writable global data; of libraries, libm and memcpy only.
 *
 * Pixel (u, v) = (column, row); the centre of the first pixel is (0, 0).
 * Camera frame: +Z along the optical axis, +X along u, +Y along v.
 * Matrices are arrays by rows.  Every function is reentrant and returns a starcal_status.
 */
#ifndef STARCAL_CAMERA_H
#define STARCAL_CAMERA_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum {
  STARCAL_TABLE_VERSION = 1,
  STARCAL_MAX_PARAMETERS = 19, /* fx skew fy cx cy, then k1 k2 k3 p1 p2 k4 .. k6 s1 .. s4 tau */
  STARCAL_MAX_WAVES = 128,     /* functions of the field along an axis; sets the stack needed */
  STARCAL_NAME_SIZE = 32,
  STARCAL_IDENTITY_SIZE = 32
};

typedef enum {
  STARCAL_OK = 0,
  STARCAL_OUTSIDE = 1,          /* result is written, but lies beyond the detector */
  STARCAL_BAD_ARGUMENT = 2,     /* null, not finite, of no length, or no alignment to give it */
  STARCAL_NO_IMAGE = 3,         /* the camera does not see the direction */
  STARCAL_NO_LINE_OF_SIGHT = 4, /* the lens model has no inverse at the pixel */
  STARCAL_NOT_A_TABLE = 5,      /* foreign data */
  STARCAL_OTHER_VERSION = 6,
  STARCAL_TRUNCATED = 7,
  STARCAL_DAMAGED = 8,          /* the CRC or a number in the table is wrong */
  STARCAL_TOO_LARGE = 9,        /* the field has more waves than STARCAL_MAX_WAVES */
  STARCAL_SELF_TEST_FAILED = 10,
  STARCAL_NOT_FINITE = 11       /* a number in the table, or of the argument, is out of range */
} starcal_status;

typedef enum {
  STARCAL_POINTING = 0, /* in the star tracker frame: camera and alignment together */
  STARCAL_SHAPE = 1     /* the camera alone, the rotation common to the detector removed */
} starcal_kind;

/* Read the fields, but change none.  The table is used in place and must outlive the camera. */
typedef struct {
  const unsigned char *table;
  uint32_t model; /* 0 plumb_bob, 1 rational_polynomial, 2 thin_prism, 3 tilted, 4 equidistant */
  uint32_t width, height;
  uint32_t parameter_count;
  uint32_t term_count; /* of the field; 0: no field */
  uint32_t rank, part_count, vector_count;
  uint32_t wave_count; /* of the field, along the axis that has more */
  int64_t time_ns; /* stamp of the last image of the calibration, Unix */
  unsigned char identity[STARCAL_IDENTITY_SIZE]; /* SHA-256 of the calibration */
  double parameters[STARCAL_MAX_PARAMETERS];     /* unused ones are 0 */
  double fold_radius2;
  double star_tracker_from_camera[9];
  double reference_degc, focal_per_degc[2], alignment_rate_rad_per_degc[3];
  double unresolved_px;
  /* Offsets of sections of the table, bytes. */
  uint32_t coefficients, factor, units, common, parts, vectors, terms, triangle;
} starcal_camera;

/* 1-sigma of lines of sight due to one cause, RMS over the detector; the first is the total. */
typedef struct {
  char cause[STARCAL_NAME_SIZE]; /* ends with a zero */
  double map_arcsec, pointing_arcsec;
} starcal_part;

/* Check a table of `starcal export --to c --table` and read a camera from it. */
starcal_status starcal_load(const unsigned char *table, size_t size, starcal_camera *camera);

/* The camera that was compiled in. */
starcal_status starcal_builtin(starcal_camera *camera);

/* Evaluate the vectors in the table, results of the Python package. */
starcal_status starcal_self_test(const starcal_camera *camera);

/* Camera and alignment at a temperature; starcal_load gives those at reference_degc. */
starcal_status starcal_at_temperature(const starcal_camera *camera, double degc,
                                      starcal_camera *result);

/* Pixel of a direction of any length; by_direction (2 x 3) may be null. */
starcal_status starcal_project(const starcal_camera *camera, const double direction_camera[3],
                               double pixel[2], double by_direction[6]);

/* Unit direction of a pixel; by_pixel (3 x 2) may be null. */
starcal_status starcal_line_of_sight(const starcal_camera *camera, const double pixel[2],
                                     double direction_camera[3], double by_pixel[6]);

/*
 * Derivatives (2 x 19) of the pixel of a direction by the parameters, without the field, and
 * (2 x 3) by a passive small rotation of the camera frame, rad.
 */
starcal_status starcal_jacobians(const starcal_camera *camera, const double direction_camera[3],
                                 double by_parameters[2 * STARCAL_MAX_PARAMETERS],
                                 double by_rotation[6]);

/*
 * Covariance of the line of sight of a pixel, rad^2: (3 x 3) in the camera frame, of rank 2, and
 * (2 x 2) along the axes of starcal_tangents.  Either may be null.
 */
starcal_status starcal_covariance(const starcal_camera *camera, const double pixel[2],
                                  starcal_kind kind, double covariance3[9],
                                  double covariance2[4]);

/* Axes across a unit direction: x and y of the camera, turned with z onto the direction. */
starcal_status starcal_tangents(const double direction_camera[3], double x[3], double y[3]);

/* A direction of the camera frame in the star tracker frame; a camera alone has none. */
starcal_status starcal_to_star_tracker(const starcal_camera *camera,
                                       const double direction_camera[3], double direction[3]);

/* Part of the sigma budget, k < part_count. */
starcal_status starcal_budget(const starcal_camera *camera, uint32_t k, starcal_part *part);

#ifdef __cplusplus
}
#endif

#endif
