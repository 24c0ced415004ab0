"""Images, attitudes and velocities in the formats of missions, to bags."""
