/* Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0 */
/* The equations are those of docs/algorithm.md and starcal_ros/camera of the Python package. */
#include "starcal_camera.h"

#include <math.h>
#include <string.h>

static const unsigned char TABLE[] = {
@TABLE@
};

enum {
  HEADER_SIZE = 120,
  CRC_START = 20,
  NEWTON_STEPS = 50,
  FIELD_STEPS = 12,
  VECTOR_SIZE = 24, /* numbers: temperature, pixel, direction, two covariances */
  PART_SIZE = STARCAL_NAME_SIZE + 16,
  MAX_TERMS = 1 << 14,
  INTRINSICS = 5,
  EQUIDISTANT = 4
};

static const unsigned char MAGIC[8] = {'S', 'T', 'A', 'R', 'C', 'A', 'L', 'T'};
static const uint32_t COEFFICIENT_COUNT[5] = {5, 8, 12, 14, 4};
static const double PI = 3.14159265358979323846;
static const double DOMAIN_SIDES = 1.35;     /* length of the cosines in sides of the detector */
static const double INVERSE_TOLERANCE = 1e-14;
static const double SAME_DIRECTION = 1e-12;
static const double SAME_COVARIANCE = 1e-6;  /* relative to the trace: large parts cancel */
static const double COLDEST_DEGC = -273.15, HOTTEST_DEGC = 1000.0;

/* ---- the table: little-endian, whatever the processor ---- */

static uint32_t u16_at(const unsigned char *at)
{
  return (uint32_t)at[0] | (uint32_t)at[1] << 8;
}

static uint32_t u32_at(const unsigned char *at)
{
  return u16_at(at) | u16_at(at + 2) << 16;
}

static double f64_at(const unsigned char *at)
{
  const uint64_t bits = (uint64_t)u32_at(at) | (uint64_t)u32_at(at + 4) << 32;
  double value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

static double number(const starcal_camera *camera, uint32_t section, uint32_t k)
{
  return f64_at(camera->table + section + 8 * (size_t)k);
}

static uint32_t crc32_of(const unsigned char *at, size_t size)
{
  static const uint32_t NIBBLE[16] = {
    0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu, 0x76dc4190u, 0x6b6b51f4u,
    0x4db26158u, 0x5005713cu, 0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu,
    0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu};
  uint32_t crc = 0xffffffffu;
  size_t k;
  for (k = 0; k < size; ++k) {
    crc ^= at[k];
    crc = crc >> 4 ^ NIBBLE[crc & 15u];
    crc = crc >> 4 ^ NIBBLE[crc & 15u];
  }
  return crc ^ 0xffffffffu;
}

static int finite_numbers(const unsigned char *at, uint64_t count)
{
  uint64_t k;
  for (k = 0; k < count; ++k) {
    if (!isfinite(f64_at(at + 8 * k))) {
      return 0;
    }
  }
  return 1;
}

/* Set the offsets of the sections; return the size of the table that they need. */
static uint64_t place_sections(starcal_camera *camera)
{
  const uint64_t p = camera->parameter_count, t = camera->term_count, r = camera->rank;
  const uint64_t rows = p + 3 + 2 * t;
  const uint64_t coefficients = HEADER_SIZE + 8 * (p + 17);
  const uint64_t factor = coefficients + 8 * 2 * t;
  const uint64_t units = factor + 8 * rows * r;
  const uint64_t common = units + 8 * 2 * t;
  const uint64_t vectors = common + 8 * 3 * (r + 2 * t);
  const uint64_t parts = vectors + 8 * VECTOR_SIZE * (uint64_t)camera->vector_count;
  const uint64_t terms = parts + PART_SIZE * (uint64_t)camera->part_count;
  const uint64_t triangle = terms + 4 * t;
  camera->coefficients = (uint32_t)coefficients;
  camera->factor = (uint32_t)factor;
  camera->units = (uint32_t)units;
  camera->common = (uint32_t)common;
  camera->vectors = (uint32_t)vectors;
  camera->parts = (uint32_t)parts;
  camera->terms = (uint32_t)terms;
  camera->triangle = (uint32_t)triangle;
  return triangle + 2 * t * (2 * t + 1);
}

static void read_header(starcal_camera *camera, const unsigned char *table)
{
  memset(camera, 0, sizeof *camera);
  camera->table = table;
  camera->model = u32_at(table + 20);
  camera->width = u32_at(table + 24);
  camera->height = u32_at(table + 28);
  camera->term_count = u32_at(table + 32);
  camera->rank = u32_at(table + 36);
  camera->part_count = u32_at(table + 40);
  camera->vector_count = u32_at(table + 44);
  camera->parameter_count = u32_at(table + 48);
  {
    const uint64_t bits = (uint64_t)u32_at(table + 64) | (uint64_t)u32_at(table + 68) << 32;
    memcpy(&camera->time_ns, &bits, sizeof bits);
  }
  memcpy(camera->identity, table + 72, STARCAL_IDENTITY_SIZE);
}

static int plausible_header(const starcal_camera *camera)
{
  return camera->model <= EQUIDISTANT && camera->width > 0 && camera->height > 0 &&
         camera->width <= 65536 && camera->height <= 65536 &&
         camera->parameter_count == INTRINSICS + COEFFICIENT_COUNT[camera->model] &&
         camera->term_count <= MAX_TERMS && camera->rank <= MAX_TERMS &&
         camera->part_count <= 256 && camera->vector_count <= 4096;
}

static starcal_status count_waves(starcal_camera *camera)
{
  uint32_t k;
  camera->wave_count = 2;
  for (k = 0; k < 2 * camera->term_count; ++k) {
    const uint32_t n = u16_at(camera->table + camera->terms + 2 * (size_t)k);
    if (n >= STARCAL_MAX_WAVES) {
      return STARCAL_TOO_LARGE;
    }
    camera->wave_count = n < camera->wave_count ? camera->wave_count : n + 1;
  }
  return STARCAL_OK;
}

static void read_numbers(starcal_camera *camera)
{
  const uint32_t p = camera->parameter_count;
  uint32_t k;
  for (k = 0; k < p; ++k) {
    camera->parameters[k] = number(camera, HEADER_SIZE, k);
  }
  camera->fold_radius2 = number(camera, HEADER_SIZE, p);
  for (k = 0; k < 9; ++k) {
    camera->star_tracker_from_camera[k] = number(camera, HEADER_SIZE, p + 1 + k);
  }
  camera->reference_degc = number(camera, HEADER_SIZE, p + 10);
  for (k = 0; k < 2; ++k) {
    camera->focal_per_degc[k] = number(camera, HEADER_SIZE, p + 11 + k);
  }
  for (k = 0; k < 3; ++k) {
    camera->alignment_rate_rad_per_degc[k] = number(camera, HEADER_SIZE, p + 13 + k);
  }
  camera->unresolved_px = number(camera, HEADER_SIZE, p + 16);
}

starcal_status starcal_load(const unsigned char *table, size_t size, starcal_camera *camera)
{
  starcal_camera found;
  starcal_status status;
  uint32_t declared, k;
  if (table == NULL || camera == NULL) {
    return STARCAL_BAD_ARGUMENT;
  }
  if (size < sizeof MAGIC || memcmp(table, MAGIC, sizeof MAGIC) != 0) {
    return STARCAL_NOT_A_TABLE;
  }
  if (size < HEADER_SIZE) {
    return STARCAL_TRUNCATED;
  }
  if (u32_at(table + 8) != STARCAL_TABLE_VERSION) {
    return STARCAL_OTHER_VERSION;
  }
  declared = u32_at(table + 12);
  if (declared > size) {
    return STARCAL_TRUNCATED;
  }
  if (declared < HEADER_SIZE ||
      crc32_of(table + CRC_START, declared - CRC_START) != u32_at(table + 16)) {
    return STARCAL_DAMAGED;
  }
  read_header(&found, table);
  if (!plausible_header(&found) || place_sections(&found) != declared ||
      !finite_numbers(table + HEADER_SIZE, (found.parts - HEADER_SIZE) / 8)) {
    return STARCAL_DAMAGED;
  }
  for (k = 0; k < found.part_count; ++k) {
    if (!finite_numbers(table + found.parts + PART_SIZE * (size_t)k + STARCAL_NAME_SIZE, 2)) {
      return STARCAL_DAMAGED;
    }
  }
  status = count_waves(&found);
  if (status != STARCAL_OK) {
    return status;
  }
  read_numbers(&found);
  if (!(found.parameters[0] > 0) || !(found.parameters[2] > 0)) {
    return STARCAL_DAMAGED;
  }
  *camera = found;
  return STARCAL_OK;
}

starcal_status starcal_builtin(starcal_camera *camera)
{
  return starcal_load(TABLE, sizeof TABLE, camera);
}

/* ---- the lens: from the ideal image plane to the distorted one ---- */

typedef struct {
  double x, y;          /* distorted point */
  double by_ideal[4];   /* 2 x 2 */
} lens_point;

/* The OpenCV models are tilted with coefficients of zero. */
static lens_point distort_opencv(const double *c, double x, double y)
{
  const double r2 = x * x + y * y;
  const double numerator = 1 + r2 * (c[0] + r2 * (c[1] + r2 * c[2]));
  const double D = 1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7]));
  const double g = numerator / D;
  const double g_r2 = (c[0] + r2 * (2 * c[1] + r2 * 3 * c[2]) -
                       g * (c[5] + r2 * (2 * c[6] + r2 * 3 * c[7]))) / D;
  const double p1 = c[3], p2 = c[4];
  const double xd = g * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (c[8] + r2 * c[9]);
  const double yd = g * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (c[10] + r2 * c[11]);
  const double cross = 2 * x * y * g_r2 + 2 * p1 * x + 2 * p2 * y;
  const double prism_x = 2 * (c[8] + 2 * c[9] * r2), prism_y = 2 * (c[10] + 2 * c[11] * r2);
  const double a = g + 2 * x * x * g_r2 + 2 * p1 * y + 6 * p2 * x + x * prism_x;
  const double b = cross + y * prism_x;
  const double e = cross + x * prism_y;
  const double f = g + 2 * y * y * g_r2 + 6 * p1 * y + 2 * p2 * x + y * prism_y;
  const double sx = sin(c[12]), cx = cos(c[12]), sy = sin(c[13]), cy = cos(c[13]);
  double w = sy * xd - cy * sx * yd + cy * cx;
  double ta, tb, tc, td;
  lens_point found;
  w = w > 0 ? w : (double)NAN; /* from behind the tilted detector */
  found.x = cx * xd / w;
  found.y = (cy * yd - sx * sy * xd) / w;
  ta = (cx - found.x * sy) / w;
  tb = found.x * cy * sx / w;
  tc = (-sx * sy - found.y * sy) / w;
  td = (cy + found.y * cy * sx) / w;
  found.by_ideal[0] = ta * a + tb * e;
  found.by_ideal[1] = ta * b + tb * f;
  found.by_ideal[2] = tc * a + td * e;
  found.by_ideal[3] = tc * b + td * f;
  return found;
}

static lens_point distort_equidistant(const double *c, double x, double y)
{
  const double r2 = x * x + y * y;
  const double g = 1 + r2 * (c[0] + r2 * (c[1] + r2 * (c[2] + r2 * c[3])));
  const double g_r2 = c[0] + r2 * (2 * c[1] + r2 * (3 * c[2] + r2 * 4 * c[3]));
  lens_point found;
  found.x = g * x;
  found.y = g * y;
  found.by_ideal[0] = g + 2 * x * x * g_r2;
  found.by_ideal[1] = found.by_ideal[2] = 2 * x * y * g_r2;
  found.by_ideal[3] = g + 2 * y * y * g_r2;
  return found;
}

static lens_point distort(const starcal_camera *camera, double x, double y)
{
  const double *c = camera->parameters + INTRINSICS;
  return camera->model == EQUIDISTANT ? distort_equidistant(c, x, y) : distort_opencv(c, x, y);
}

/* Derivatives (2 x 14) of the distorted point by the coefficients. */
static void by_coefficients(const starcal_camera *camera, double x, double y, double J[28])
{
  const double *c = camera->parameters + INTRINSICS;
  const double r2 = x * x + y * y;
  double *Jx = J, *Jy = J + 14;
  uint32_t k;
  memset(J, 0, 28 * sizeof *J);
  if (camera->model == EQUIDISTANT) {
    double power = r2;
    for (k = 0; k < 4; ++k, power *= r2) {
      Jx[k] = x * power;
      Jy[k] = y * power;
    }
    return;
  }
  {
    double untilted[14];
    const double D = 1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7]));
    const double g = (1 + r2 * (c[0] + r2 * (c[1] + r2 * c[2]))) / D;
    const double sx = sin(c[12]), cx = cos(c[12]), sy = sin(c[13]), cy = cos(c[13]);
    double power = r2 / D, w, xt, yt, w_by_x, w_by_y;
    lens_point flat;
    for (k = 0; k < 3; ++k, power *= r2) {
      Jx[k] = x * power;
      Jy[k] = y * power;
      Jx[5 + k] = -g * Jx[k];
      Jy[5 + k] = -g * Jy[k];
    }
    Jx[3] = Jy[4] = 2 * x * y;
    Jx[4] = r2 + 2 * x * x;
    Jy[3] = r2 + 2 * y * y;
    Jx[8] = Jy[10] = r2;
    Jx[9] = Jy[11] = r2 * r2;
    memcpy(untilted, c, sizeof untilted);
    untilted[12] = untilted[13] = 0.0;
    flat = distort_opencv(untilted, x, y);
    w = sy * flat.x - cy * sx * flat.y + cy * cx;
    xt = cx * flat.x / w;
    yt = (cy * flat.y - sx * sy * flat.x) / w;
    for (k = 0; k < 12; ++k) {
      const double jx = Jx[k], jy = Jy[k];
      Jx[k] = ((cx - xt * sy) * jx + xt * cy * sx * jy) / w;
      Jy[k] = ((-sx * sy - yt * sy) * jx + (cy + yt * cy * sx) * jy) / w;
    }
    w_by_x = -cy * (cx * flat.y + sx);
    w_by_y = cy * flat.x + sy * (sx * flat.y - cx);
    Jx[12] = (-sx * flat.x - xt * w_by_x) / w;
    Jy[12] = (-cx * sy * flat.x - yt * w_by_x) / w;
    Jx[13] = -xt * w_by_y / w;
    Jy[13] = (-sy * flat.y - sx * cy * flat.x - yt * w_by_y) / w;
  }
}

/* ---- the ideal image plane ---- */

static int ideal_point(const starcal_camera *camera, const double d[3], double xy[2])
{
  double scale;
  if (camera->model == EQUIDISTANT) {
    const double rho = hypot(d[0], d[1]), length = hypot(rho, d[2]);
    if (rho == 0) {
      scale = 1 / d[2];
    } else {
      scale = 2 * atan(d[2] > 0 ? rho / (length + d[2]) : (length - d[2]) / rho) / rho;
    }
  } else {
    scale = 1 / d[2];
  }
  if ((camera->model != EQUIDISTANT || hypot(d[0], d[1]) == 0) && !(d[2] > 0)) {
    return 0;
  }
  xy[0] = d[0] * scale;
  xy[1] = d[1] * scale;
  return xy[0] * xy[0] + xy[1] * xy[1] <= camera->fold_radius2;
}

static void direction_of(const starcal_camera *camera, const double xy[2], double d[3])
{
  const double r = hypot(xy[0], xy[1]);
  if (camera->model == EQUIDISTANT) {
    const double sine = r > 0 ? sin(r) / r : 1.0;
    d[0] = xy[0] * sine;
    d[1] = xy[1] * sine;
    d[2] = cos(r);
  } else {
    const double length = hypot(r, 1.0);
    d[0] = xy[0] / length;
    d[1] = xy[1] / length;
    d[2] = 1 / length;
  }
}

/* (1 - theta / tan(theta)) / theta^2 of a squared angle: 1/3 on the axis. */
static double bend(double r2)
{
  if (r2 < 0.04) {
    return 1.0 / 3 + r2 * (1.0 / 45 + r2 * (2.0 / 945 + r2 * (1.0 / 4725 +
           r2 * (2.0 / 93555 + r2 * 1382.0 / 638512875))));
  }
  return (1 - sqrt(r2) / tan(sqrt(r2))) / r2;
}

/* Derivatives (2 x 3) of the ideal point by a passive small rotation of the camera frame. */
static void ideal_by_rotation(const starcal_camera *camera, const double xy[2], double J[6])
{
  const double x = xy[0], y = xy[1];
  if (camera->model == EQUIDISTANT) {
    const double m = bend(x * x + y * y);
    J[0] = m * x * y;
    J[1] = m * y * y - 1;
    J[3] = 1 - m * x * x;
  } else {
    J[0] = x * y;
    J[1] = -1 - x * x;
    J[3] = 1 + y * y;
  }
  J[2] = y;
  J[4] = -J[0];
  J[5] = -x;
}

/* Derivatives (2 x 3) of the pixel by a passive small rotation, without the field. */
static void pixel_by_rotation(const starcal_camera *camera, const double xy[2], double J[6])
{
  const double *c = camera->parameters;
  const lens_point point = distort(camera, xy[0], xy[1]);
  double turn[6];
  int k;
  ideal_by_rotation(camera, xy, turn);
  for (k = 0; k < 3; ++k) {
    const double xd = point.by_ideal[0] * turn[k] + point.by_ideal[1] * turn[3 + k];
    const double yd = point.by_ideal[2] * turn[k] + point.by_ideal[3] * turn[3 + k];
    J[k] = c[0] * xd + c[1] * yd;
    J[3 + k] = c[2] * yd;
  }
}

static void cross(const double a[3], const double b[3], double result[3])
{
  result[0] = a[1] * b[2] - a[2] * b[1];
  result[1] = a[2] * b[0] - a[0] * b[2];
  result[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double a[3], const double b[3])
{
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* ---- the field beside the lens model ---- */

typedef struct {
  double u[STARCAL_MAX_WAVES], v[STARCAL_MAX_WAVES];     /* functions along the axes */
  double du[STARCAL_MAX_WAVES], dv[STARCAL_MAX_WAVES];   /* and their slopes, per px */
} waves;

static void cosines(double x, double by_pixel, uint32_t count, double *f, double *slope)
{
  const double c1 = cos(PI * x), s1 = sin(PI * x);
  double c = 1.0, s = 0.0;
  uint32_t n;
  f[0] = 1.0;
  slope[0] = 0.0;
  for (n = 1; n < count; ++n) {
    const double next = c * c1 - s * s1;
    s = s * c1 + c * s1;
    c = next;
    f[n] = sqrt(2.0) * c;
    slope[n] = -sqrt(2.0) * PI * n * s * by_pixel;
  }
}

/* Beyond the detector the field is that at its border. */
static void waves_along(const starcal_camera *camera, double pixel, uint32_t size, double *f,
                        double *slope)
{
  const double inside = pixel < -0.5 ? -0.5 : pixel > size - 0.5 ? size - 0.5 : pixel;
  const double moves = inside == pixel ? 1.0 : 0.0;
  cosines(((inside + 0.5) / size - 0.5) / DOMAIN_SIDES + 0.5, moves / (DOMAIN_SIDES * size),
          camera->wave_count, f, slope);
}

static void waves_at(const starcal_camera *camera, const double pixel[2], waves *found)
{
  waves_along(camera, pixel[0], camera->width, found->u, found->du);
  waves_along(camera, pixel[1], camera->height, found->v, found->dv);
}

/* Displacement (2) and, where not null, its derivatives (2 x 2) by the measured pixel. */
static void field_at(const starcal_camera *camera, const double pixel[2], double moved[2],
                     double slope[4])
{
  waves found;
  uint32_t k;
  moved[0] = moved[1] = 0.0;
  if (slope != NULL) {
    slope[0] = slope[1] = slope[2] = slope[3] = 0.0;
  }
  if (camera->term_count == 0) {
    return;
  }
  waves_at(camera, pixel, &found);
  for (k = 0; k < camera->term_count; ++k) {
    const unsigned char *term = camera->table + camera->terms + 4 * (size_t)k;
    const uint32_t i = u16_at(term), j = u16_at(term + 2);
    const double a = number(camera, camera->coefficients, k);
    const double b = number(camera, camera->coefficients, camera->term_count + k);
    moved[0] += a * found.u[i] * found.v[j];
    moved[1] += b * found.u[i] * found.v[j];
    if (slope != NULL) {
      slope[0] += a * found.du[i] * found.v[j];
      slope[1] += a * found.u[i] * found.dv[j];
      slope[2] += b * found.du[i] * found.v[j];
      slope[3] += b * found.u[i] * found.dv[j];
    }
  }
}

/* ---- projection and its inverse ---- */

static int all_finite(const double *values, int count)
{
  int k;
  for (k = 0; k < count; ++k) {
    if (!isfinite(values[k])) {
      return 0;
    }
  }
  return 1;
}

/* Status of results (count): no caller takes one that is not finite for a number. */
static starcal_status checked(starcal_status status, const double *results, int count)
{
  return all_finite(results, count) ? status : STARCAL_NOT_FINITE;
}

static int unit_of(const double direction[3], double unit[3], double *length)
{
  int k;
  if (!all_finite(direction, 3)) {
    return 0;
  }
  *length = hypot(hypot(direction[0], direction[1]), direction[2]);
  if (!(*length > 0) || !isfinite(*length)) {
    return 0;
  }
  for (k = 0; k < 3; ++k) {
    unit[k] = direction[k] / *length;
  }
  return 1;
}

static starcal_status on_detector(const starcal_camera *camera, const double pixel[2])
{
  const int inside = pixel[0] >= -0.5 && pixel[0] <= camera->width - 0.5 && pixel[1] >= -0.5 &&
                     pixel[1] <= camera->height - 0.5;
  return inside ? STARCAL_OK : STARCAL_OUTSIDE;
}

starcal_status starcal_project(const starcal_camera *camera, const double direction_camera[3],
                               double pixel[2], double by_direction[6])
{
  double d[3], xy[2], lens[2], at[2], moved[2], slope[4], length;
  const double *c;
  lens_point point;
  int k;
  if (camera == NULL || direction_camera == NULL || pixel == NULL ||
      !unit_of(direction_camera, d, &length)) {
    return STARCAL_BAD_ARGUMENT;
  }
  if (!ideal_point(camera, d, xy)) {
    return STARCAL_NO_IMAGE;
  }
  c = camera->parameters;
  point = distort(camera, xy[0], xy[1]);
  lens[0] = c[0] * point.x + c[1] * point.y + c[3];
  lens[1] = c[2] * point.y + c[4];
  if (!all_finite(lens, 2)) {
    return STARCAL_NO_IMAGE;
  }
  at[0] = lens[0];
  at[1] = lens[1];
  for (k = 0; k < FIELD_STEPS && camera->term_count != 0; ++k) {
    const double before[2] = {at[0], at[1]};
    field_at(camera, at, moved, NULL);
    at[0] = lens[0] + moved[0];
    at[1] = lens[1] + moved[1];
    if (at[0] == before[0] && at[1] == before[1]) {
      break;
    }
  }
  if (by_direction != NULL) {
    double turn[6], row_u[3], row_v[3], determinant;
    field_at(camera, at, moved, slope);
    pixel_by_rotation(camera, xy, turn);
    cross(d, turn, row_u);
    cross(d, turn + 3, row_v);
    /* (1 - f') (pixel by direction) is that of the lens alone. */
    determinant = ((1 - slope[0]) * (1 - slope[3]) - slope[1] * slope[2]) * length;
    for (k = 0; k < 3; ++k) {
      by_direction[k] = ((1 - slope[3]) * row_u[k] + slope[1] * row_v[k]) / determinant;
      by_direction[3 + k] = (slope[2] * row_u[k] + (1 - slope[0]) * row_v[k]) / determinant;
    }
    if (!all_finite(by_direction, 6)) {
      return STARCAL_NOT_FINITE;
    }
  }
  pixel[0] = at[0];
  pixel[1] = at[1];
  return checked(on_detector(camera, pixel), pixel, 2);
}

/* Keep a point within the fold: one beyond it is put halfway there by radius. */
static void keep_inside(const starcal_camera *camera, const double before[2], double after[2])
{
  const double radius = hypot(after[0], after[1]);
  if (radius * radius >= camera->fold_radius2) {
    const double halfway = 0.5 * (hypot(before[0], before[1]) + sqrt(camera->fold_radius2));
    after[0] *= halfway / radius;
    after[1] *= halfway / radius;
  }
}

/* Ideal point of a distorted one by Newton's iteration; 0 where the model has no inverse. */
static int undistort(const starcal_camera *camera, const double target[2], double xy[2])
{
  static const double AXIS[2] = {0.0, 0.0};
  const double size = fmax(fabs(target[0]), fabs(target[1]));
  double error[2] = {INFINITY, INFINITY}, determinant = 0.0;
  int k;
  xy[0] = target[0];
  xy[1] = target[1];
  keep_inside(camera, AXIS, xy);
  for (k = 0; k < NEWTON_STEPS; ++k) {
    const lens_point point = distort(camera, xy[0], xy[1]);
    const double *J = point.by_ideal;
    double step[2], moved[2], length, reach;
    error[0] = point.x - target[0];
    error[1] = point.y - target[1];
    determinant = J[0] * J[3] - J[1] * J[2];
    if (fmax(fabs(error[0]), fabs(error[1])) < INVERSE_TOLERANCE) {
      break;
    }
    step[0] = (J[3] * error[0] - J[1] * error[1]) / determinant;
    step[1] = (J[0] * error[1] - J[2] * error[0]) / determinant;
    if (!all_finite(step, 2)) {
      return 0;
    }
    /* A step longer than the radius itself has left the branch: shorten it. */
    reach = 0.5 + hypot(xy[0], xy[1]);
    length = hypot(step[0], step[1]);
    moved[0] = xy[0] - step[0] * (length > reach ? reach / length : 1.0);
    moved[1] = xy[1] - step[1] * (length > reach ? reach / length : 1.0);
    keep_inside(camera, xy, moved);
    xy[0] = moved[0];
    xy[1] = moved[1];
  }
  return fmax(fabs(error[0]), fabs(error[1])) <= 1e-12 * (1 + size) && determinant > 0 &&
         xy[0] * xy[0] + xy[1] * xy[1] <= camera->fold_radius2;
}

static void tangents(const double d[3], double x[3], double y[3])
{
  const double scale = 1 / (1 + d[2]);
  x[0] = 1 - d[0] * d[0] * scale;
  x[1] = y[0] = -d[0] * d[1] * scale;
  x[2] = -d[0];
  y[1] = 1 - d[1] * d[1] * scale;
  y[2] = -d[1];
}

starcal_status starcal_tangents(const double direction_camera[3], double x[3], double y[3])
{
  double d[3], length;
  if (direction_camera == NULL || x == NULL || y == NULL ||
      !unit_of(direction_camera, d, &length) || !(1 + d[2] > 0)) {
    return STARCAL_BAD_ARGUMENT;
  }
  tangents(d, x, y);
  return STARCAL_OK;
}

/* A line of sight, and the change (3 x 2) of the direction by the pixel of the lens model. */
static starcal_status sight(const starcal_camera *camera, const double pixel[2], double xy[2],
                            double d[3], double by_lens_pixel[6])
{
  const double *c = camera->parameters;
  double moved[2], target[2], turn[6], row_u[3], row_v[3], x[3], y[3];
  double a, b, e, f, determinant;
  int k;
  field_at(camera, pixel, moved, NULL);
  target[1] = (pixel[1] - moved[1] - c[4]) / c[2];
  target[0] = (pixel[0] - moved[0] - c[3] - c[1] * target[1]) / c[0];
  if (!undistort(camera, target, xy)) {
    return STARCAL_NO_LINE_OF_SIGHT;
  }
  direction_of(camera, xy, d);
  if (by_lens_pixel != NULL) {
    pixel_by_rotation(camera, xy, turn);
    cross(d, turn, row_u);
    cross(d, turn + 3, row_v);
    tangents(d, x, y);
    a = dot(row_u, x);
    b = dot(row_u, y);
    e = dot(row_v, x);
    f = dot(row_v, y);
    determinant = a * f - b * e;
    for (k = 0; k < 3; ++k) {
      by_lens_pixel[2 * k] = (x[k] * f - y[k] * e) / determinant;
      by_lens_pixel[2 * k + 1] = (y[k] * a - x[k] * b) / determinant;
    }
  }
  return STARCAL_OK;
}

starcal_status starcal_line_of_sight(const starcal_camera *camera, const double pixel[2],
                                     double direction_camera[3], double by_pixel[6])
{
  double xy[2], d[3], by_lens[6], moved[2], slope[4];
  starcal_status status;
  int k;
  if (camera == NULL || pixel == NULL || direction_camera == NULL || !all_finite(pixel, 2)) {
    return STARCAL_BAD_ARGUMENT;
  }
  status = sight(camera, pixel, xy, d, by_pixel == NULL ? NULL : by_lens);
  if (status != STARCAL_OK) {
    return status;
  }
  if (by_pixel != NULL) {
    field_at(camera, pixel, moved, slope);
    for (k = 0; k < 3; ++k) {
      const double a = by_lens[2 * k], b = by_lens[2 * k + 1];
      by_pixel[2 * k] = a * (1 - slope[0]) - b * slope[2];
      by_pixel[2 * k + 1] = b * (1 - slope[3]) - a * slope[1];
    }
    if (!all_finite(by_pixel, 6)) {
      return STARCAL_NOT_FINITE;
    }
  }
  memcpy(direction_camera, d, sizeof d);
  return checked(on_detector(camera, pixel), d, 3);
}

static void jacobian_of_parameters(const starcal_camera *camera, const double xy[2],
                                   double J[2 * STARCAL_MAX_PARAMETERS])
{
  const double *c = camera->parameters;
  const lens_point point = distort(camera, xy[0], xy[1]);
  double columns[28];
  double *Ju = J, *Jv = J + STARCAL_MAX_PARAMETERS;
  int k;
  memset(J, 0, 2 * STARCAL_MAX_PARAMETERS * sizeof *J);
  Ju[0] = point.x;
  Ju[1] = Jv[2] = point.y;
  Ju[3] = Jv[4] = 1.0;
  by_coefficients(camera, xy[0], xy[1], columns);
  for (k = 0; k < 14; ++k) {
    Ju[INTRINSICS + k] = c[0] * columns[k] + c[1] * columns[14 + k];
    Jv[INTRINSICS + k] = c[2] * columns[14 + k];
  }
}

starcal_status starcal_jacobians(const starcal_camera *camera, const double direction_camera[3],
                                 double by_parameters[2 * STARCAL_MAX_PARAMETERS],
                                 double by_rotation[6])
{
  double d[3], xy[2], length;
  if (camera == NULL || direction_camera == NULL || by_parameters == NULL ||
      by_rotation == NULL || !unit_of(direction_camera, d, &length)) {
    return STARCAL_BAD_ARGUMENT;
  }
  if (!ideal_point(camera, d, xy)) {
    return STARCAL_NO_IMAGE;
  }
  jacobian_of_parameters(camera, xy, by_parameters);
  pixel_by_rotation(camera, xy, by_rotation);
  return checked(checked(STARCAL_OK, by_parameters, 2 * STARCAL_MAX_PARAMETERS), by_rotation, 6);
}

/* ---- covariance ---- */

static void add_outer(double covariance[9], const double a[3])
{
  int i, j;
  for (i = 0; i < 3; ++i) {
    for (j = 0; j < 3; ++j) {
      covariance[3 * i + j] += a[i] * a[j];
    }
  }
}

/* Take off the movement by the common rotation of a column of the root of the covariance. */
static void remove_common(const starcal_camera *camera, const double d[3], uint32_t column,
                          double moved[3])
{
  const uint32_t columns = camera->rank + 2 * camera->term_count;
  double rotation[3], turned[3];
  int k;
  for (k = 0; k < 3; ++k) {
    rotation[k] = number(camera, camera->common, (uint32_t)k * columns + column);
  }
  cross(rotation, d, turned);
  for (k = 0; k < 3; ++k) {
    moved[k] -= turned[k];
  }
}

/* A displacement of the pixel moves the direction the other way. */
static void add_moved(const double by_lens[6], const double pixel[2], double moved[3])
{
  int k;
  for (k = 0; k < 3; ++k) {
    moved[k] -= by_lens[2 * k] * pixel[0] + by_lens[2 * k + 1] * pixel[1];
  }
}

static double phi(const starcal_camera *camera, const waves *at, uint32_t k)
{
  const unsigned char *term = camera->table + camera->terms + 4 * (size_t)k;
  return at->u[u16_at(term)] * at->v[u16_at(term + 2)];
}

/* Columns of the factor: the parameters, the alignment, and the field as it follows them. */
static void add_factor(const starcal_camera *camera, const double xy[2], const double d[3],
                       const double by_lens[6], const waves *at, starcal_kind kind,
                       double covariance[9])
{
  const uint32_t p = camera->parameter_count, t = camera->term_count, r = camera->rank;
  double J[2 * STARCAL_MAX_PARAMETERS];
  uint32_t column, k;
  jacobian_of_parameters(camera, xy, J);
  for (column = 0; column < r; ++column) {
    double pixel[2] = {0.0, 0.0}, moved[3] = {0.0, 0.0, 0.0}, turn[3];
    for (k = 0; k < p; ++k) {
      const double value = number(camera, camera->factor, k * r + column);
      pixel[0] += J[k] * value;
      pixel[1] += J[STARCAL_MAX_PARAMETERS + k] * value;
    }
    for (k = 0; k < t; ++k) {
      const double f = phi(camera, at, k);
      pixel[0] += f * number(camera, camera->factor, (p + 3 + k) * r + column);
      pixel[1] += f * number(camera, camera->factor, (p + 3 + t + k) * r + column);
    }
    if (kind == STARCAL_POINTING) {
      for (k = 0; k < 3; ++k) {
        turn[k] = number(camera, camera->factor, (p + k) * r + column);
      }
      cross(turn, d, moved);
    }
    add_moved(by_lens, pixel, moved);
    if (kind == STARCAL_SHAPE) {
      remove_common(camera, d, column, moved);
    }
    add_outer(covariance, moved);
  }
}

/* Columns of the triangle, one after the other: the field, the parameters known. */
static void add_triangle(const starcal_camera *camera, const double d[3],
                         const double by_lens[6], const waves *at, starcal_kind kind,
                         double covariance[9])
{
  const uint32_t t = camera->term_count;
  const unsigned char *entry = camera->table + camera->triangle;
  uint32_t column, row;
  for (column = 0; column < 2 * t; ++column) {
    double pixel[2] = {0.0, 0.0}, moved[3] = {0.0, 0.0, 0.0};
    for (row = column; row < 2 * t; ++row, entry += 2) {
      const uint32_t bits = u16_at(entry);
      const double value = bits < 32768u ? (double)bits : (double)bits - 65536.0;
      pixel[row < t ? 0 : 1] += value * number(camera, camera->units, row) *
                                phi(camera, at, row < t ? row : row - t);
    }
    add_moved(by_lens, pixel, moved);
    if (kind == STARCAL_SHAPE) {
      remove_common(camera, d, camera->rank + column, moved);
    }
    add_outer(covariance, moved);
  }
}

static void in_tangents(const double d[3], const double covariance3[9], double covariance2[4])
{
  double axes[2][3], across[3];
  int i, j, k;
  tangents(d, axes[0], axes[1]);
  for (i = 0; i < 2; ++i) {
    for (k = 0; k < 3; ++k) {
      across[k] = dot(covariance3 + 3 * k, axes[i]);
    }
    for (j = 0; j < 2; ++j) {
      covariance2[2 * i + j] = dot(across, axes[j]);
    }
  }
}

/* A camera that was calibrated alone has a matrix of zeros. */
static int has_alignment(const starcal_camera *camera)
{
  const double *row = camera->star_tracker_from_camera;
  return row[0] != 0.0 || row[1] != 0.0 || row[2] != 0.0;
}

starcal_status starcal_covariance(const starcal_camera *camera, const double pixel[2],
                                  starcal_kind kind, double covariance3[9],
                                  double covariance2[4])
{
  double xy[2], d[3], by_lens[6], found[9] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
  waves at;
  starcal_status status;
  int k;
  if (camera == NULL || pixel == NULL || !all_finite(pixel, 2) ||
      (kind != STARCAL_SHAPE && (kind != STARCAL_POINTING || !has_alignment(camera)))) {
    return STARCAL_BAD_ARGUMENT;
  }
  status = sight(camera, pixel, xy, d, by_lens);
  if (status != STARCAL_OK) {
    return status;
  }
  waves_at(camera, pixel, &at);
  add_factor(camera, xy, d, by_lens, &at, kind, found);
  add_triangle(camera, d, by_lens, &at, kind, found);
  for (k = 0; k < 2; ++k) {
    const double step[2] = {k == 0 ? camera->unresolved_px : 0.0,
                            k == 1 ? camera->unresolved_px : 0.0};
    double moved[3] = {0.0, 0.0, 0.0};
    add_moved(by_lens, step, moved);
    add_outer(found, moved);
  }
  if (covariance3 != NULL) {
    memcpy(covariance3, found, sizeof found);
  }
  if (covariance2 != NULL) {
    in_tangents(d, found, covariance2);
    if (!all_finite(covariance2, 4)) {
      return STARCAL_NOT_FINITE;
    }
  }
  return checked(on_detector(camera, pixel), found, 9);
}

/* ---- temperature, alignment, budget, self-test ---- */

starcal_status starcal_at_temperature(const starcal_camera *camera, double degc,
                                      starcal_camera *result)
{
  double above, factor, turn[3], angle, sine, cosine;
  const double *A;
  int i, k;
  if (camera == NULL || result == NULL || !(degc >= COLDEST_DEGC && degc <= HOTTEST_DEGC)) {
    return STARCAL_BAD_ARGUMENT;
  }
  above = degc - camera->reference_degc;
  factor = 1 + above * (camera->focal_per_degc[0] + above * camera->focal_per_degc[1]);
  if (!(factor > 0)) {
    return STARCAL_BAD_ARGUMENT;
  }
  for (k = 0; k < 3; ++k) {
    turn[k] = above * camera->alignment_rate_rad_per_degc[k];
  }
  angle = sqrt(dot(turn, turn));
  sine = angle > 0 ? sin(angle) / angle : 1.0;
  cosine = angle > 0 ? 2 * sin(0.5 * angle) * sin(0.5 * angle) / (angle * angle) : 0.5;
  {
    const starcal_camera before = *camera; /* result may be camera */
    *result = before;
    A = before.star_tracker_from_camera;
    for (k = 0; k < 3; ++k) {
      result->parameters[k] = before.parameters[k] * factor;
    }
    for (i = 0; i < 3; ++i) {
      double along[3], twice[3];
      /* The rows of A exp([turn x]). */
      cross(A + 3 * i, turn, along);
      cross(along, turn, twice);
      for (k = 0; k < 3; ++k) {
        result->star_tracker_from_camera[3 * i + k] =
          A[3 * i + k] + sine * along[k] + cosine * twice[k];
      }
    }
  }
  /* The terms hold from the reference only: a camera at a temperature has none. */
  result->reference_degc = degc;
  result->focal_per_degc[0] = result->focal_per_degc[1] = 0.0;
  memset(result->alignment_rate_rad_per_degc, 0, sizeof result->alignment_rate_rad_per_degc);
  return checked(checked(STARCAL_OK, result->parameters, STARCAL_MAX_PARAMETERS),
                 result->star_tracker_from_camera, 9);
}

starcal_status starcal_to_star_tracker(const starcal_camera *camera,
                                       const double direction_camera[3], double direction[3])
{
  double turned[3];
  int k;
  if (camera == NULL || direction_camera == NULL || direction == NULL ||
      !all_finite(direction_camera, 3) || !has_alignment(camera)) {
    return STARCAL_BAD_ARGUMENT;
  }
  for (k = 0; k < 3; ++k) {
    turned[k] = dot(camera->star_tracker_from_camera + 3 * k, direction_camera);
  }
  memcpy(direction, turned, sizeof turned);
  return checked(STARCAL_OK, direction, 3);
}

starcal_status starcal_budget(const starcal_camera *camera, uint32_t k, starcal_part *part)
{
  const unsigned char *at;
  if (camera == NULL || part == NULL || k >= camera->part_count) {
    return STARCAL_BAD_ARGUMENT;
  }
  at = camera->table + camera->parts + PART_SIZE * (size_t)k;
  memcpy(part->cause, at, STARCAL_NAME_SIZE);
  part->cause[STARCAL_NAME_SIZE - 1] = '\0';
  part->map_arcsec = f64_at(at + STARCAL_NAME_SIZE);
  part->pointing_arcsec = f64_at(at + STARCAL_NAME_SIZE + 8);
  return STARCAL_OK;
}

static int same_covariance(const double *found, const starcal_camera *camera, uint32_t first)
{
  double trace = 0.0, worst = 0.0;
  uint32_t k;
  for (k = 0; k < 9; ++k) {
    const double expected = number(camera, camera->vectors, first + k);
    worst = fmax(worst, fabs(found[k] - expected));
    trace += k % 4 == 0 ? expected : 0.0;
  }
  return worst <= SAME_COVARIANCE * trace;
}

starcal_status starcal_self_test(const starcal_camera *camera)
{
  uint32_t k, j;
  if (camera == NULL) {
    return STARCAL_BAD_ARGUMENT;
  }
  for (k = 0; k < camera->vector_count; ++k) {
    const uint32_t first = VECTOR_SIZE * k;
    starcal_camera there;
    double pixel[2], d[3], back[2], covariance[9];
    pixel[0] = number(camera, camera->vectors, first + 1);
    pixel[1] = number(camera, camera->vectors, first + 2);
    if (starcal_at_temperature(camera, number(camera, camera->vectors, first), &there) !=
          STARCAL_OK || starcal_line_of_sight(&there, pixel, d, NULL) != STARCAL_OK) {
      return STARCAL_SELF_TEST_FAILED;
    }
    for (j = 0; j < 3; ++j) {
      if (!(fabs(d[j] - number(camera, camera->vectors, first + 3 + j)) <= SAME_DIRECTION)) {
        return STARCAL_SELF_TEST_FAILED;
      }
    }
    /* A pixel on the border may come back a rounding beyond it. */
    if (starcal_project(&there, d, back, NULL) > STARCAL_OUTSIDE ||
        !(hypot(back[0] - pixel[0], back[1] - pixel[1]) <= 1e-6) ||
        (has_alignment(camera) &&
         (starcal_covariance(&there, pixel, STARCAL_POINTING, covariance, NULL) != STARCAL_OK ||
          !same_covariance(covariance, camera, first + 6))) ||
        starcal_covariance(&there, pixel, STARCAL_SHAPE, covariance, NULL) != STARCAL_OK ||
        !same_covariance(covariance, camera, first + 15)) {
      return STARCAL_SELF_TEST_FAILED;
    }
  }
  return STARCAL_OK;
}
