"""The driver node: raw frames of a device, simulated, played back or on USB, as topics."""
