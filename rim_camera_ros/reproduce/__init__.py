"""The thesis' experiments simulated and reduced, beside the numbers that the thesis prints."""
