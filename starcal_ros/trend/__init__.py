"""Calibrations of a camera, or of a fleet, over years."""
