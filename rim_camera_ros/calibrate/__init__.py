"""Calibration: recordings -> stations -> normal equations -> parameters with their uncertainty."""
