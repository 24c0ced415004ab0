/* Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0 */
/*
 * check_camera status TABLE            status of starcal_load
 * check_camera selftest [TABLE]        status of starcal_self_test
 * check_camera budget                  parts of the budget
 * check_camera sights [TABLE]          reads lines "degc u v", writes numbers in hexadecimal
 * check_camera pixels                  reads lines "x y z", writes status and pixel
 */
#include "starcal_camera.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static unsigned char buffer[1 << 22];

static starcal_status load(const char *path, starcal_camera *camera)
{
  FILE *file;
  unsigned char *exact;
  size_t size;
  starcal_status status;
  if (path == NULL) {
    return starcal_builtin(camera);
  }
  file = fopen(path, "rb");
  if (file == NULL) {
    exit(9);
  }
  size = fread(buffer, 1, sizeof buffer, file);
  fclose(file);
  /* A copy of the exact size: the sanitizer sees a read beyond it. */
  exact = (unsigned char *)malloc(size + (size == 0));
  memcpy(exact, buffer, size);
  status = starcal_load(exact, size, camera);
  free(exact);
  return status == STARCAL_OK ? starcal_load(buffer, size, camera) : status;
}

static void show(const double *values, int count)
{
  int k;
  for (k = 0; k < count; ++k) {
    printf(" %a", values[k]);
  }
}

static void sights(const starcal_camera *camera)
{
  double degc, pixel[2];
  while (scanf("%lf %lf %lf", &degc, &pixel[0], &pixel[1]) == 3) {
    starcal_camera there;
    double d[3], by_pixel[6], back[2], by_direction[6], pointing[9], shape[9], across[4];
    double by_parameters[2 * STARCAL_MAX_PARAMETERS], by_rotation[6], tracker[3];
    starcal_status status;
    if (starcal_at_temperature(camera, degc, &there) != STARCAL_OK) {
      exit(8);
    }
    status = starcal_line_of_sight(&there, pixel, d, by_pixel);
    if (status > STARCAL_OUTSIDE ||
        starcal_project(&there, d, back, by_direction) > STARCAL_OUTSIDE ||
        starcal_covariance(&there, pixel, STARCAL_POINTING, pointing, across) != status ||
        starcal_covariance(&there, pixel, STARCAL_SHAPE, shape, NULL) != status ||
        starcal_jacobians(&there, d, by_parameters, by_rotation) != STARCAL_OK ||
        starcal_to_star_tracker(&there, d, tracker) != STARCAL_OK) {
      printf("%d\n", (int)status);
      continue;
    }
    printf("%d", (int)status);
    show(d, 3);
    show(by_pixel, 6);
    show(back, 2);
    show(by_direction, 6);
    show(pointing, 9);
    show(shape, 9);
    show(across, 4);
    show(by_parameters, 2 * STARCAL_MAX_PARAMETERS);
    show(by_rotation, 6);
    show(tracker, 3);
    printf("\n");
  }
}

static void pixels(const starcal_camera *camera)
{
  double d[3], pixel[2];
  while (scanf("%lf %lf %lf", &d[0], &d[1], &d[2]) == 3) {
    const starcal_status status = starcal_project(camera, d, pixel, NULL);
    printf("%d", (int)status);
    show(pixel, status > STARCAL_OUTSIDE ? 0 : 2);
    printf("\n");
  }
}

int main(int argc, char **argv)
{
  starcal_camera camera;
  starcal_status status;
  uint32_t k;
  if (argc < 2) {
    return 9;
  }
  status = load(argc > 2 ? argv[2] : NULL, &camera);
  if (strcmp(argv[1], "status") == 0) {
    return (int)status;
  }
  if (status != STARCAL_OK) {
    return 100 + (int)status;
  }
  if (strcmp(argv[1], "selftest") == 0) {
    return (int)starcal_self_test(&camera);
  }
  if (strcmp(argv[1], "sights") == 0) {
    sights(&camera);
  } else if (strcmp(argv[1], "pixels") == 0) {
    pixels(&camera);
  } else if (strcmp(argv[1], "budget") == 0) {
    starcal_part part;
    for (k = 0; k < STARCAL_IDENTITY_SIZE; ++k) {
      printf("%02x", camera.identity[k]);
    }
    printf("\n");
    for (k = 0; starcal_budget(&camera, k, &part) == STARCAL_OK; ++k) {
      printf("%s: %a %a\n", part.cause, part.map_arcsec, part.pointing_arcsec);
    }
  }
  return 0;
}
