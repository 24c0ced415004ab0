"""MCAP bags: reading and writing."""
