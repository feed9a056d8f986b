"""Recordings of other drivers, read by a profile that says what their topics mean."""
