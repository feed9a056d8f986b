"""Calibration: the command over `fit` and `select`, what it checks before and states afterwards."""
