"""Residuals of stars, their normal equations and the solver."""
