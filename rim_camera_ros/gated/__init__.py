"""Gated (shuttered) cameras: distances from the shares of a light pulse that gates transmit."""
