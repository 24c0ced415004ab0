"""HTML report with its figures and pictures."""
