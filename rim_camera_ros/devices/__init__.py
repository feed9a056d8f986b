"""Devices: whatever delivers raw frames, behind one interface."""
