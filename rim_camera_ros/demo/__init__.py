"""The demonstration: simulate, correct and record over DDS, then compare with the known scene."""
