"""Recordings of other drivers, read by a profile that describes their topics."""
