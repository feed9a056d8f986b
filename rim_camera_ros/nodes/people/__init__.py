"""The node that follows people through corrected clouds."""
