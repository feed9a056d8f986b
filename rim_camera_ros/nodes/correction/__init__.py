"""The correction node: raw frames in, corrected clouds and images out."""
