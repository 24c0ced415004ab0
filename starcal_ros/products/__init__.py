"""The files that a calibration leaves."""
