"""Faults that running nodes must survive, each as a function that returns what it measured.

``make soak DURATION=seconds`` runs all of them for so long; short versions are in test_faults.py.
"""
