"""Star catalog, apparent directions of stars, and star-tracker attitudes."""
