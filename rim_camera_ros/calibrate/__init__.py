"""Calibration: the command over `fit` and `select`, its checks of recordings, and its stated results."""
