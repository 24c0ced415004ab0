"""From the brightest sources of one image to its stars, without attitude or alignment."""
