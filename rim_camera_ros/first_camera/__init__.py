"""A first camera file from a recording: geometry, step, saturation, noise, gain, and the source of each."""
