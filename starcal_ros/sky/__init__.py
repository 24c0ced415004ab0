"""Where the stars are: catalog, apparent directions, attitudes."""
