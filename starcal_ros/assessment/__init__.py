"""Whether a calibration is good: gate, observability, comparison, residuals."""
