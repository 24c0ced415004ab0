"""
In-flight geometric calibration of a spacecraft camera from images of stars.

After Christian, Benhacine, Hikes and D'Souza, "Geometric Calibration of the Orion Optical
Navigation Camera using Star Field Images", J. Astronaut. Sci. 2016,
DOI 10.1007/s40295-016-0091-3.  Equation numbers in the docstrings are that paper's.

Conventions of the whole package:

- Frames: ``icrf`` (inertial), ``star_tracker``, ``camera`` (+x right, +y down, +z out).
- ``b_from_a`` transforms coordinates in frame a to coordinates in frame b.
- Quaternions are scalar-last (x, y, z, w).
- Small angles are passive rotations in the camera frame:
  ``camera_from_icrf <- exp(-[dtheta x]) camera_from_icrf``  (Eq. 11).
- Pixels are (u right, v down); the centre of the first pixel is (0, 0); images index ``[v, u]``.
- Angles are in radians internally and in arcseconds in reports; times are integer nanoseconds
  since the Unix epoch (UTC, as ROS stamps); directions are unit vectors; xyz is the last axis.
"""
