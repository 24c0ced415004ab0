"""How good a calibration is: observability, model checks, comparison, residuals."""
