"""The three methods of calibration as least-squares problems."""
