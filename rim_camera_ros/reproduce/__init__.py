"""The thesis' experiments simulated and reduced, and compared with the numbers that the thesis prints."""
