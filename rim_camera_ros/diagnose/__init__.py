"""Diagnosis: where simulation and recording differ, what physics was left out, and a model of it."""
