"""Monte Carlo studies."""
