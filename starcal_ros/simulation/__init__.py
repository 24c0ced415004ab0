"""Simulated star fields, images and bags with known truth."""
