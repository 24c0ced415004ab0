"""Synthetic skies, images and bags with known truth."""
