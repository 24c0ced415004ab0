"""Errors that no camera parameter describes: their tests and their variances."""
