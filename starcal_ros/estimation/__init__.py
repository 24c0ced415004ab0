"""From observations to camera, alignment and covariance."""
