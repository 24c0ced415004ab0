"""Whether a calibration may become active."""
