"""From measured stars to catalog stars."""
