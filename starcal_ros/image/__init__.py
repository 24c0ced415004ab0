"""From pixels to measured stars."""
