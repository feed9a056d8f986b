"""Measures the hot paths against straightforward numpy: ``make bench``."""
