"""The HTML report, its figures and pictures."""
