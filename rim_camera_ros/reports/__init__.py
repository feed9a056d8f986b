"""Figures and pages of the reports, shared by calibration and diagnosis."""
