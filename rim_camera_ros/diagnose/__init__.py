"""Diagnosis: where simulation and recording differ, which physics is missing, and a model of it."""
